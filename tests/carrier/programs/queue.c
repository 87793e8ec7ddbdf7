/* A thread that writes records as fast as it can and drops the oldest ones, and one that takes them. Fails unless each
 * record was either dropped or taken, once, whole, and in order. The arguments are how many records there are, and how
 * many bytes the ring has. */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>

#include "check.h"
#include "ring.h"

enum { LONGEST = 40, WORDS_TAKEN = 256 }; /* words of a record; words that are taken at once */

union head {
    uint32_t size; /* bytes */
    uint64_t word;
};

static struct ring *ring;
static uint64_t count;
static uint8_t *dropped, *taken; /* by number: each is written by one thread */
static _Atomic bool has_ended;

static uint64_t filling(uint64_t number, uint64_t word) { return (number + 1) * 0x9e3779b97f4a7c15u + word; }

static uint32_t words_of(uint64_t number) { return 2 + (uint32_t)(filling(number, 0) >> 32) % (LONGEST - 1); }

/* Record NUMBER: its size, its number, and words that depend on it. */
static uint32_t make(uint64_t number, uint64_t *record) {
    uint32_t words = words_of(number);
    union head head = {.word = 0};
    head.size = words * 8;
    record[0] = head.word;
    record[1] = number;
    for (uint32_t word = 2; word < words; word++) record[word] = filling(number, word);
    return head.size;
}

static void mark(uint8_t *list, const uint64_t *record, int64_t *last) {
    uint64_t number = record[1];
    check(number < count, "the number is one that was written");
    check((int64_t)number > *last, "the order is kept");
    *last = (int64_t)number;
    list[number] = 1;
}

static void *write_all(void *unused) {
    int64_t last = -1;
    for (uint64_t number = 0; number < count; number++) {
        uint64_t record[LONGEST], oldest[2];
        uint32_t size = make(number, record);
        while (!ring_put(ring, record, size))
            if (ring_drop(ring, oldest, sizeof oldest)) mark(dropped, oldest, &last);
        if (number % 64 == 0) sched_yield();
    }
    return unused;
}

static void take_some(int64_t timeout) {
    static int64_t last = -1;
    uint64_t records[WORDS_TAKEN];
    size_t words = ring_take(ring, records, sizeof records, timeout) / 8;
    for (size_t at = 0; at < words;) {
        union head head = {.word = records[at]};
        uint64_t number = records[at + 1];
        check(head.size == words_of(number) * 8 && at + head.size / 8 <= words, "the size is right");
        for (uint32_t word = 2; word < head.size / 8; word++)
            check(records[at + word] == filling(number, word), "the record is whole");
        mark(taken, &records[at], &last);
        at += head.size / 8;
    }
}

static void *take_all(void *unused) {
    while (!atomic_load(&has_ended)) take_some(-1);
    while (atomic_load(&ring->written) != atomic_load(&ring->taken)) take_some(0);
    return unused;
}

int main(int arguments, char **values) {
    check(arguments == 3, "two arguments");
    count = strtoull(values[1], NULL, 10);
    ring = ring_open(strtoull(values[2], NULL, 10));
    dropped = calloc(count, 1);
    taken = calloc(count, 1);
    check(ring && dropped && taken, "there is memory");
    pthread_t writer, reader;
    pthread_create(&reader, NULL, take_all, NULL);
    pthread_create(&writer, NULL, write_all, NULL);
    pthread_join(writer, NULL);
    atomic_store(&has_ended, true);
    ring_wake(ring);
    pthread_join(reader, NULL);
    uint64_t all_dropped = 0, all_taken = 0;
    for (uint64_t number = 0; number < count; number++) {
        check(dropped[number] + taken[number] == 1, "each record was either taken or dropped");
        all_dropped += dropped[number];
        all_taken += taken[number];
    }
    printf("%llu dropped, %llu taken\n", (unsigned long long)all_dropped, (unsigned long long)all_taken);
    ring_close(ring);
    free(dropped);
    free(taken);
    return 0;
}
