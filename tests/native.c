/* A library that looks up a name, as native code does. */
#include <netdb.h>
int look_up(void) { struct addrinfo *found; return getaddrinfo("native.invalid", "80", 0, &found); }
