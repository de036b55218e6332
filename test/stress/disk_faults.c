/* SPDX-License-Identifier: Apache-2.0
 *
 * Loaded before libc (LD_PRELOAD), it makes the disk fail under the files of one folder:
 *
 *   DISK_FAULT          enospc, eio, short (half of each write) or slow (each fsync)
 *   DISK_FAULT_FOLDER   files whose path contains this
 *   DISK_FAULT_AFTER    bytes that are written before
 *   DISK_FAULT_CALLS    how many calls fail; 0: all
 *   DISK_FAULT_SECONDS  how slow a slow fsync is
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

static atomic_llong written, failed;

static const char *fault(void) {
    const char *name = getenv("DISK_FAULT");
    return name ? name : "";
}

static long long number(const char *name) {
    const char *text = getenv(name);
    return text ? atoll(text) : 0;
}

static int ours(int descriptor) {
    const char *folder = getenv("DISK_FAULT_FOLDER");
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t size = readlink(link, path, sizeof path - 1);
    if (!folder || size <= 0)
        return 0;
    path[size] = 0;
    return strstr(path, folder) && strstr(path, ".mcap");
}

static int due(void) {
    long long calls = number("DISK_FAULT_CALLS");
    return atomic_load(&written) >= number("DISK_FAULT_AFTER") &&
           (calls == 0 || atomic_fetch_add(&failed, 1) < calls);
}

/* The size to write instead, or -1 with errno. */
static ssize_t allowed(int descriptor, size_t size) {
    int saved = errno;
    int here = ours(descriptor);
    errno = saved;
    if (!here)
        return (ssize_t)size;
    if (due()) {
        if (!strcmp(fault(), "enospc") || !strcmp(fault(), "eio")) {
            errno = strcmp(fault(), "eio") ? ENOSPC : EIO;
            return -1;
        }
        if (!strcmp(fault(), "short") && size > 1)
            size /= 2;
    }
    atomic_fetch_add(&written, (long long)size);
    return (ssize_t)size;
}

ssize_t write(int descriptor, const void *data, size_t size) {
    static ssize_t (*real)(int, const void *, size_t);
    if (!real)
        real = (ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
    ssize_t most = allowed(descriptor, size);
    return most < 0 ? -1 : real(descriptor, data, (size_t)most);
}

ssize_t pwrite64(int descriptor, const void *data, size_t size, off64_t offset) {
    static ssize_t (*real)(int, const void *, size_t, off64_t);
    if (!real)
        real = (ssize_t (*)(int, const void *, size_t, off64_t))dlsym(RTLD_NEXT, "pwrite64");
    ssize_t most = allowed(descriptor, size);
    return most < 0 ? -1 : real(descriptor, data, (size_t)most, offset);
}

ssize_t pwrite(int descriptor, const void *data, size_t size, off_t offset) {
    return pwrite64(descriptor, data, size, offset);
}

static int sync_as(const char *name, int descriptor) {
    int (*real)(int) = (int (*)(int))dlsym(RTLD_NEXT, name);
    if (ours(descriptor) && due()) {
        if (!strcmp(fault(), "eio")) {
            errno = EIO;
            return -1;
        }
        if (!strcmp(fault(), "slow")) {
            struct timespec rest = {number("DISK_FAULT_SECONDS"), 0};
            nanosleep(&rest, NULL);
        }
    }
    return real(descriptor);
}

int fsync(int descriptor) {
    return sync_as("fsync", descriptor);
}

int fdatasync(int descriptor) {
    return sync_as("fdatasync", descriptor);
}
