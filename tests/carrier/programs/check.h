/* What ends a test program, with a message. */
#ifndef CHECK_H
#define CHECK_H

#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>

static inline void check(bool holds, const char *what) {
    if (holds) return;
    printf("failed: %s\n", what);
    exit(1);
}

#endif
