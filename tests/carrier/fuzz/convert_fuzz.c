/* A libFuzzer target: `message_read` and `datagram_write` read and write only what they may, whatever a message holds.
 *
 * An input's first byte chooses a program, the message follows. */
#include <stdlib.h>
#include <string.h>

#include "convert.h"
#include "conversions.h"
#include "outcome.h"

static void demand(bool condition) {
    if (!condition) abort();
}

int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size) {
    if (size == 0) return -1;
    const struct conversion *chosen = &conversions[input[0] % CONVERSION_COUNT];
    size--;
    uint8_t *message = malloc(size ? size : 1); /* of the exact size: the sanitizer sees what is read behind it */
    memcpy(message, input + 1, size);
    static struct slot slots[MOST_SLOTS];
    static uint8_t datagram[MOST_CONVERTED];
    size_t written = 0;
    if (message_read(chosen->reads, chosen->read_count, message, size, slots)) {
        for (size_t index = 0; index < chosen->slot_count; index++) demand(slots[index].start <= size);
        if (datagram_write(chosen->writes, chosen->write_count, chosen->literals, message, slots, datagram, &written)) {
            demand(written <= MOST_CONVERTED);
            demand(written == MOST_CONVERTED || datagram[MOST_CONVERTED - written] != 0); /* the first byte of a tag */
            note_outcome(datagram + MOST_CONVERTED - written, written);
        }
    }
    free(message);
    return 0;
}
