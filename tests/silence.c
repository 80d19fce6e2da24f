/* Notes every connection and look-up in the file that SILENCE_LOG names, and refuses it. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void note(const char *what, const char *whom) {
    const char *path = getenv("SILENCE_LOG");
    char line[300];
    int handle = path ? open(path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600) : -1;
    if (handle < 0) return;
    snprintf(line, sizeof line, "%s %.200s\n", what, whom ? whom : "");
    if (write(handle, line, strlen(line)) < 0) abort();
    close(handle);
}

static int far(const struct sockaddr *to) {
    return to && (to->sa_family == AF_INET || to->sa_family == AF_INET6);
}

int connect(int socket, const struct sockaddr *to, socklen_t length) {
    if (far(to)) { note("connect", ""); errno = ECONNREFUSED; return -1; }
    int (*real)(int, const struct sockaddr *, socklen_t) = dlsym(RTLD_NEXT, "connect");
    return real(socket, to, length);
}

ssize_t sendto(int socket, const void *data, size_t size, int flags,
               const struct sockaddr *to, socklen_t length) {
    if (far(to)) { note("sendto", ""); errno = ECONNREFUSED; return -1; }
    ssize_t (*real)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
    real = dlsym(RTLD_NEXT, "sendto");
    return real(socket, data, size, flags, to, length);
}

ssize_t sendmsg(int socket, const struct msghdr *message, int flags) {
    if (message && far(message->msg_name)) { note("sendmsg", ""); errno = ECONNREFUSED; return -1; }
    ssize_t (*real)(int, const struct msghdr *, int) = dlsym(RTLD_NEXT, "sendmsg");
    return real(socket, message, flags);
}

int getaddrinfo(const char *node, const char *service,
                const struct addrinfo *hints, struct addrinfo **found) {
    note("getaddrinfo", node);
    return EAI_FAIL;
}

struct hostent *gethostbyname(const char *name) { note("gethostbyname", name); return NULL; }
struct hostent *gethostbyname2(const char *name, int family) {
    note("gethostbyname2", name);
    return NULL;
}
int gethostbyname_r(const char *name, struct hostent *entry, char *buffer, size_t size,
                    struct hostent **found, int *error) {
    note("gethostbyname_r", name);
    *found = NULL;
    *error = NO_RECOVERY;
    return ENOENT;
}
