#include "serial.h"

#include <asm/termbits.h> /* termios2, which <termios.h> lacks: it takes any baud rate */
#include <errno.h>
#include <fcntl.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <unistd.h>

static int set_up(int fd, const struct serial *settings) {
    struct termios2 line;
    if (ioctl(fd, TCGETS2, &line)) return errno;
    line.c_iflag = settings->parity == PARITY_NONE ? 0 : INPCK; /* a byte with a wrong parity bit is read as 0 */
    line.c_oflag = line.c_lflag = 0;
    /* Without HUPCL: closing would drop DTR, which resets many boards. */
    line.c_cflag = CS8 | CREAD | CLOCAL | BOTHER;
    if (settings->parity != PARITY_NONE) line.c_cflag |= PARENB;
    if (settings->parity == PARITY_ODD) line.c_cflag |= PARODD;
    if (settings->stop_bits == 2) line.c_cflag |= CSTOPB;
    line.c_ispeed = line.c_ospeed = settings->baud;
    line.c_cc[VMIN] = 1; /* reading nothing is EAGAIN; 0 is the end of the line */
    line.c_cc[VTIME] = 0;
    return ioctl(fd, TCSETS2, &line) || ioctl(fd, TCFLSH, TCIOFLUSH) ? errno : 0;
}

/* TIOCEXCL makes other processes fail to open the device, except for those of root, which see the lock if they look. */
static int take(int fd) {
    if (flock(fd, LOCK_EX | LOCK_NB)) return errno == EWOULDBLOCK ? EBUSY : errno;
    return ioctl(fd, TIOCEXCL) ? errno : 0;
}

int serial_open(const char *path, const struct serial *settings) {
    int fd = open(path, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    if (fd < 0) return -errno;
    int error = take(fd);
    if (!error) error = set_up(fd, settings);
    if (!error) return fd;
    close(fd);
    return -error;
}

int serial_waiting(int fd) {
    int waiting;
    return ioctl(fd, TIOCOUTQ, &waiting) ? 0 : waiting;
}

void serial_close(int fd) {
    if (serial_waiting(fd)) ioctl(fd, TCFLSH, TCOFLUSH); /* of a pty it would discard what has arrived */
    ioctl(fd, TIOCNXCL);
    close(fd);
}
