/* What Python asks the library when it loads it: library.py. */

const char *carrier_checksum(void);

/* The checksum of the sources that this library was made of. */
const char *carrier_checksum(void) { return CARRIER_CHECKSUM; }
