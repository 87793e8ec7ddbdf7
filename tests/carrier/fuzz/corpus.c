/* In place of libFuzzer: gives each input of a folder to the target once, in the order of their names, and prints the
 * outcomes in hexadecimal digits. */
#include <dirent.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "outcome.h"

enum { LONGEST = 1 << 16 };

__attribute__((weak)) int LLVMFuzzerInitialize(int *count, char ***arguments);
int LLVMFuzzerTestOneInput(const uint8_t *input, size_t size);

void note_outcome(const void *made, size_t size) {
    const uint8_t *bytes = made;
    putchar(' ');
    for (size_t index = 0; index < size; index++) printf("%02x", bytes[index]);
}

static int is_input(const struct dirent *entry) { return entry->d_name[0] != '.'; }

int main(int count, char **arguments) {
    static uint8_t input[LONGEST];
    struct dirent **entries;
    if (count != 2 || chdir(arguments[1])) return 1;
    if (LLVMFuzzerInitialize) LLVMFuzzerInitialize(&count, &arguments);
    int inputs = scandir(".", &entries, is_input, alphasort);
    if (inputs <= 0) return 1;
    for (int index = 0; index < inputs; index++) {
        FILE *file = fopen(entries[index]->d_name, "rb");
        if (!file) return 1;
        size_t size = fread(input, 1, sizeof input, file);
        fclose(file);
        printf("%s", entries[index]->d_name);
        LLVMFuzzerTestOneInput(input, size);
        putchar('\n');
    }
    return 0;
}
