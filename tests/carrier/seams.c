/* What tests look at and change in the structures of the carrier, and inline functions. A library of its own. */
#include "deadman.h"
#include "limit.h"

int64_t seam_next_due(struct deadmen *deadmen) { return atomic_load(&deadmen->next_due); }
int64_t seam_timer_set_for(struct deadmen *deadmen) { return deadmen->timer_set_for; }
int seam_timer(struct deadmen *deadmen) { return deadmen->timer; }
void seam_lock(struct deadmen *deadmen) { pthread_mutex_lock(&deadmen->lock); }
void seam_unlock(struct deadmen *deadmen) { pthread_mutex_unlock(&deadmen->lock); }
bool seam_limit_passes(struct limit *limit, int64_t now) { return limit_passes(limit, now); }
