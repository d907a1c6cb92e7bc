/* Lets the program's n-th change of a file below a folder go wrong; loaded in front of the C library
 * (LD_PRELOAD).
 *
 *   FAULT_UNDER  the folder
 *   FAULT_AT     which change, from 1; 0: none
 *   FAULT_KIND   eio    the change fails, once
 *                full   it and all that would need space after it fail
 *                short  half of a write is done and said so, which is no error
 *                torn   half of a write is done, and the next change fails
 *                kill   half of a write is done, or nothing, and the process is gone
 *   FAULT_LOG    a line for each change goes there
 *   FAULT_CLOCK  the time of day is another decade each time it is asked for
 *
 * The disk is not waited for: what a process leaves behind is looked at here, not what a power cut leaves.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static long count;
static int full, torn;

static int below(const char *path) {
    const char *under = getenv("FAULT_UNDER");
    return under && path && strncmp(path, under, strlen(under)) == 0;
}

static int below_fd(int fd) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = syscall(SYS_readlink, link, path, sizeof path - 1);
    if (n <= 0) return 0;
    path[n] = 0;
    return below(path);
}

/* What becomes of a change: an errno, 0 for nothing special, -1 for half of it, -2 for half of it and the
 * end. */
static int fate(const char *what, int needs_space, int is_write) {
    pthread_mutex_lock(&lock);
    const char *kind = getenv("FAULT_KIND"), *at = getenv("FAULT_AT"), *log = getenv("FAULT_LOG");
    if (!kind) kind = "";
    int now = ++count == (at ? atol(at) : 0), result = 0;
    if (log) {
        int fd = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND, 0644);
        char line[64];
        syscall(SYS_write, fd, line, snprintf(line, sizeof line, "%ld %s\n", count, what));
        syscall(SYS_close, fd);
    }
    if (torn) {
        torn = 0;
        result = EIO;
    } else if (full && needs_space) {
        result = ENOSPC;
    } else if (now && !strcmp(kind, "eio")) {
        result = EIO;
    } else if (now && !strcmp(kind, "full")) {
        full = 1;
        result = needs_space ? ENOSPC : 0;
    } else if (now && !strcmp(kind, "short")) {
        result = is_write ? -1 : 0;
    } else if (now && !strcmp(kind, "torn")) {
        torn = is_write;
        result = is_write ? -1 : EIO;
    } else if (now && !strcmp(kind, "kill")) {
        result = -2;
        if (!is_write) raise(SIGKILL);
    }
    pthread_mutex_unlock(&lock);
    return result;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* A change that is done whole or not at all. */
#define CHANGE(watched, name, needs_space, ...)                                                                        \
    int f = (watched) ? fate(#name, needs_space, 0) : 0;                                                               \
    if (f > 0) {                                                                                                       \
        errno = f;                                                                                                     \
        return -1;                                                                                                     \
    }                                                                                                                  \
    return REAL(name)(__VA_ARGS__)

ssize_t write(int fd, const void *bytes, size_t size) {
    int f = size && below_fd(fd) ? fate("write", 1, 1) : 0;
    if (f > 0) {
        errno = f;
        return -1;
    }
    ssize_t done = syscall(SYS_write, fd, bytes, f < 0 && size > 1 ? size / 2 : size);
    if (f == -2) raise(SIGKILL);
    return done;
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    CHANGE(flags & (O_WRONLY | O_RDWR | O_CREAT) && below(path), open64, flags & O_CREAT, path, flags, mode);
}

int fsync(int fd) {
    int f = below_fd(fd) ? fate("fsync", 1, 0) : 0;
    if (f > 0) errno = f;
    return f > 0 ? -1 : 0;
}

int fchmod(int fd, mode_t mode) { CHANGE(below_fd(fd), fchmod, 0, fd, mode); }
int rename(const char *from, const char *to) { CHANGE(below(to), rename, 1, from, to); }
int mkdir(const char *path, mode_t mode) { CHANGE(below(path), mkdir, 1, path, mode); }
int unlink(const char *path) { CHANGE(below(path), unlink, 0, path); }
int rmdir(const char *path) { CHANGE(below(path), rmdir, 0, path); }
ssize_t copy_file_range(int in, off64_t *at, int out, off64_t *to, size_t size, unsigned flags) {
    int f = below_fd(out) ? fate("copy_file_range", 1, 1) : 0;
    if (f > 0) {
        errno = f;
        return -1;
    }
    ssize_t done = REAL(copy_file_range)(in, at, out, to, f < 0 && size > 1 ? size / 2 : size, flags);
    if (f == -2) raise(SIGKILL);
    return done;
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    int result = syscall(SYS_clock_gettime, clock, time);
    if (clock == CLOCK_REALTIME && getenv("FAULT_CLOCK")) {
        static long asked;
        time->tv_sec += (asked++ % 3 - 3) * 400000000L;
    }
    return result;
}
