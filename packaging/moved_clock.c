/* Moves the wall clock of a process by the seconds in /var/lib/companion/moved_clock, as if it were
   set; other clocks stay. For try_service.sh: LD_PRELOAD=moved_clock.so */
#define _GNU_SOURCE
#include <stdio.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

int clock_gettime(clockid_t clock, struct timespec *now) {
    int code = (int)syscall(SYS_clock_gettime, clock, now);
    if (code != 0 || clock != CLOCK_REALTIME)
        return code;
    FILE *file = fopen("/var/lib/companion/moved_clock", "r");
    long moved_s = 0;
    if (file != NULL) {
        if (fscanf(file, "%ld", &moved_s) == 1)
            now->tv_sec += moved_s;
        fclose(file);
    }
    return 0;
}
