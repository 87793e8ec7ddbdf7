#include "ring.h"

#include <linux/futex.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { WORD = sizeof(uint64_t) };

struct ring *ring_open(size_t capacity) {
    struct ring *ring = calloc(1, sizeof *ring);
    if (!ring) return NULL;
    ring->capacity = capacity;
    ring->words = malloc(capacity);
    if (ring->words) memset((void *)ring->words, 0, capacity); /* now, so that page faults do not delay the writer */
    ring->wake = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    if (!ring->words || ring->wake < 0) {
        ring_close(ring);
        return NULL;
    }
    return ring;
}

void ring_close(struct ring *ring) {
    if (ring->wake >= 0) close(ring->wake);
    free((void *)ring->words);
    free(ring);
}

static _Atomic uint64_t *word_at(struct ring *ring, uint64_t position) {
    return &ring->words[(position & (ring->capacity - 1)) / WORD];
}

/* The words are atomic because the reader may copy a record while the writer has dropped it and writes the next one there.
 * The copy is then discarded. */
static void copy_out(struct ring *ring, uint64_t position, void *to, size_t size) {
    uint64_t *words = to;
    for (size_t done = 0; done < size; done += WORD)
        *words++ = atomic_load_explicit(word_at(ring, position + done), memory_order_relaxed);
}

static uint32_t size_at(struct ring *ring, uint64_t position) {
    union { uint64_t word; uint32_t size; } head = {atomic_load_explicit(word_at(ring, position), memory_order_relaxed)};
    return head.size;
}

/* Wake the reader if it sleeps or is about to, once for all records written until then. The full fences here and in
 * `ring_take` separate each side's stores from its later loads: either the reader sees the record or the request, or the
 * writer sees that it waits. Sequentially consistent stores and loads would suffice on a processor, but qemu-user for
 * aarch64 reorders them. */
static void wake_reader(struct ring *ring) {
    atomic_thread_fence(memory_order_seq_cst);
    if (atomic_load_explicit(&ring->is_watched, memory_order_relaxed)) eventfd_write(ring->wake, 1);
    if (atomic_load_explicit(&ring->is_waited_for, memory_order_relaxed) && atomic_exchange(&ring->is_waited_for, 0))
        syscall(SYS_futex, &ring->is_waited_for, FUTEX_WAKE_PRIVATE, 1, NULL, NULL, 0);
}

/* Append a record. Return the bytes that are in use then, or 0 if there is no room. */
static inline uint64_t append_record(struct ring *ring, const void *record, uint32_t size) {
    uint64_t written = atomic_load_explicit(&ring->written, memory_order_relaxed);
    uint64_t taken = atomic_load_explicit(&ring->taken, memory_order_acquire);
    if (written - taken + size > ring->capacity) return 0;
    const uint64_t *words = record;
    /* A reader that sees one of these words also sees that the earlier record was dropped. */
    atomic_thread_fence(memory_order_release);
    for (uint32_t done = 0; done < size; done += WORD)
        atomic_store_explicit(word_at(ring, written + done), *words++, memory_order_relaxed);
    atomic_store_explicit(&ring->written, written + size, memory_order_release);
    return written - taken + size;
}

bool ring_put(struct ring *ring, const void *record, uint32_t size) {
    if (!append_record(ring, record, size)) return false;
    wake_reader(ring);
    return true;
}

bool ring_put_quietly(struct ring *ring, const void *record, uint32_t size) {
    uint64_t used = append_record(ring, record, size);
    if (used > ring->capacity / 2) wake_reader(ring);
    return used;
}

bool ring_drop(struct ring *ring, void *record, size_t limit) {
    uint64_t taken = atomic_load_explicit(&ring->taken, memory_order_acquire);
    if (taken == atomic_load_explicit(&ring->written, memory_order_relaxed)) return false;
    uint32_t size = size_at(ring, taken);
    copy_out(ring, taken, record, size < limit ? size : limit);
    return atomic_compare_exchange_strong(&ring->taken, &taken, taken + size);
}

/* The size of the record at `taken`. If it was overwritten meanwhile, this may be any possible size, or 0. */
static uint32_t record_at(struct ring *ring, uint64_t taken) {
    uint32_t size = size_at(ring, taken);
    return size >= WORD && size % WORD == 0 && size <= ring->capacity ? size : 0;
}

/* Whether nothing was dropped since `taken` was read: then everything that was read of the record is valid. */
static bool is_oldest(struct ring *ring, uint64_t taken) {
    atomic_thread_fence(memory_order_acquire);
    return atomic_load_explicit(&ring->taken, memory_order_relaxed) == taken;
}

static bool claim(struct ring *ring, uint64_t taken, uint32_t size) {
    atomic_thread_fence(memory_order_acquire);
    return atomic_compare_exchange_strong(&ring->taken, &taken, taken + size);
}

static size_t take_ready(struct ring *ring, void *records, size_t limit) {
    size_t copied = 0;
    for (;;) {
        uint64_t taken = atomic_load_explicit(&ring->taken, memory_order_acquire);
        if (atomic_load_explicit(&ring->written, memory_order_acquire) == taken) return copied;
        uint32_t size = record_at(ring, taken);
        if (size > limit - copied) {
            if (is_oldest(ring, taken)) return copied;
        } else if (size) {
            copy_out(ring, taken, (char *)records + copied, size);
            if (claim(ring, taken, size)) copied += size;
        }
    }
}

/* Sleep while `is_waited_for`, for up to `timeout` ns (-1: forever). */
static void sleep_until_woken(struct ring *ring, int64_t timeout) {
    struct timespec until = {timeout / 1000000000, timeout % 1000000000};
    syscall(SYS_futex, &ring->is_waited_for, FUTEX_WAIT_PRIVATE, 1, timeout < 0 ? NULL : &until, NULL, 0);
}

bool ring_is_empty(const struct ring *ring) {
    return atomic_load_explicit(&ring->written, memory_order_acquire)
           == atomic_load_explicit(&ring->taken, memory_order_relaxed);
}

size_t ring_take(struct ring *ring, void *records, size_t limit, int64_t timeout) {
    size_t copied = take_ready(ring, records, limit);
    if (copied || !timeout) return copied;
    atomic_store_explicit(&ring->is_waited_for, 1, memory_order_relaxed);
    atomic_thread_fence(memory_order_seq_cst);
    copied = take_ready(ring, records, limit);
    if (!copied && !atomic_exchange(&ring->is_woken, false)) {
        sleep_until_woken(ring, timeout);
        copied = take_ready(ring, records, limit);
    }
    atomic_store(&ring->is_waited_for, 0);
    return copied;
}

void ring_wake(struct ring *ring) {
    atomic_store_explicit(&ring->is_woken, true, memory_order_release);
    wake_reader(ring);
}

int ring_watch(struct ring *ring) {
    atomic_store(&ring->is_watched, true);
    return ring->wake;
}
