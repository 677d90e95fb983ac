/* Makes the disk under the folder DISK_FOLDER slow, full or read-only for a program it is preloaded into, as long as a
 * file called `slow`, `full` or `read-only` lies in the folder DISK_FAULTS. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(name) *)dlsym(RTLD_NEXT, #name))

static int is_on(const char *fault) {
    char path[4096];
    const char *folder = getenv("DISK_FAULTS");
    snprintf(path, sizeof path, "%s/%s", folder ? folder : "/nowhere", fault);
    return access(path, F_OK) == 0;
}

static int lies_on_disk(const char *path) {
    const char *folder = getenv("DISK_FOLDER");
    return folder && path && strncmp(path, folder, strlen(folder)) == 0;
}

static int is_on_disk(int file) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return lies_on_disk(path);
}

/* What a change of the disk has to wait for, and the error that it ends with; 0: none. */
static int fault(int needs_room) {
    while (is_on("slow")) usleep(10000);
    if (is_on("read-only")) return EROFS;
    return needs_room && is_on("full") ? ENOSPC : 0;
}

ssize_t write(int file, const void *bytes, size_t count) {
    int error = is_on_disk(file) ? fault(1) : 0;
    if (error) return errno = error, -1;
    return REAL(write)(file, bytes, count);
}

int fdatasync(int file) {
    int error = is_on_disk(file) ? fault(1) : 0;
    if (error) return errno = error, -1;
    return REAL(fdatasync)(file);
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    mode_t mode = va_arg(rest, mode_t);
    va_end(rest);
    int changes = (flags & O_ACCMODE) != O_RDONLY || (flags & O_CREAT);
    int error = changes && lies_on_disk(path) ? fault(1) : 0;
    if (error) return errno = error, -1;
    return REAL(open64)(path, flags, mode);
}

int rename(const char *from, const char *to) {
    int error = lies_on_disk(from) ? fault(0) : 0;
    if (error) return errno = error, -1;
    return REAL(rename)(from, to);
}

int unlink(const char *path) {
    int error = lies_on_disk(path) ? fault(0) : 0;
    if (error) return errno = error, -1;
    return REAL(unlink)(path);
}
