/* Loaded before everything else, adds to the wall clock of a process and its children what a shared file says. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static int (*real)(clockid_t, struct timespec *);
static const volatile int64_t *ahead_s;

__attribute__((constructor)) static void begin(void) {
    const char *folder = getenv("WALL_CLOCKS"), *inherited = getenv("WALL_CLOCK");
    char own[4096];
    real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    snprintf(own, sizeof own, "%s/%d", folder ? folder : ".", getpid());
    int file = open(inherited ? inherited : own, O_RDWR | O_CREAT, 0600);
    if (file < 0 || ftruncate(file, sizeof *ahead_s)) abort();
    ahead_s = mmap(NULL, sizeof *ahead_s, PROT_READ, MAP_SHARED, file, 0);
    if (ahead_s == MAP_FAILED) abort();
    close(file);
    setenv("WALL_CLOCK", inherited ? inherited : own, 1);
}

int clock_gettime(clockid_t which, struct timespec *at) {
    int failed = real(which, at);
    if (!failed && (which == CLOCK_REALTIME || which == CLOCK_REALTIME_COARSE)) at->tv_sec += *ahead_s;
    return failed;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
    struct timespec now;
    (void)zone;
    int failed = clock_gettime(CLOCK_REALTIME, &now);
    at->tv_sec = now.tv_sec, at->tv_usec = now.tv_nsec / 1000;
    return failed;
}

time_t time(time_t *at) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return at ? *at = now.tv_sec : now.tv_sec;
}
