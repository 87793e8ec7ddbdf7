/* A target gives what it has made of an input to `note_outcome`: corpus.c prints it, libFuzzer has no use for it. */
#ifndef OUTCOME_H
#define OUTCOME_H

#include <stddef.h>

#ifdef PRINTS_OUTCOMES
void note_outcome(const void *made, size_t size);
#else
static inline void note_outcome(const void *made, size_t size) { (void)made, (void)size; }
#endif

#endif
