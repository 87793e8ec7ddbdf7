/* Opens serial devices. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdint.h>

enum parity { PARITY_NONE, PARITY_EVEN, PARITY_ODD };

struct serial {
    uint32_t baud;      /* any that the driver can divide its clock down to */
    uint32_t parity;    /* enum parity */
    uint32_t stop_bits; /* 1 or 2 */
    uint32_t reserved;
};

/* Open a device for this process alone: raw, 8 data bits, no flow control, without blocking. What had arrived and what waited to
 * be sent is discarded. Return the descriptor, or a negative errno: -EBUSY if another process has the device, -ENOTTY if it is
 * no serial device. */
int serial_open(const char *path, const struct serial *settings);

/* The number of bytes that the kernel has still to send. */
int serial_waiting(int fd);

/* Discard what waits to be sent, for which closing would wait, and close the device. */
void serial_close(int fd);

#endif
