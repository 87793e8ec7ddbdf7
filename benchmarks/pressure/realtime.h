/* The wall clock, as kernel time stamps have it, and a priority above all that shares the core. */
#pragma once
#include <sched.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

static inline int64_t realtime_ns(void) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  return now.tv_sec * 1000000000LL + now.tv_nsec;
}

/* 1 if the priority was given; it takes a privilege. */
static inline int be_realtime(void) {
  prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
  mlockall(MCL_CURRENT);
  return sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = 10}) == 0;
}
