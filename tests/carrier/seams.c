/* What tests look at and change in the structures of the carrier. A library of its own. */
#include "sender.h"
#include "timers.h"

int64_t seam_next_due(struct timers *timers) { return atomic_load(&timers->next_due); }
int64_t seam_timer_set_for(struct timers *timers) { return timers->timer_set_for; }
int seam_timer(struct timers *timers) { return timers->timer; }
void seam_lock(struct timers *timers) { pthread_mutex_lock(&timers->lock); }
void seam_unlock(struct timers *timers) { pthread_mutex_unlock(&timers->lock); }
/* As if somebody had refused what it has sent. */
void seam_refuse(struct sender *sender, int error) { atomic_store(&sender->refused, error); }
