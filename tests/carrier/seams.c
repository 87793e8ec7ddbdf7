/* What tests look at and change in the structures of the carrier. A library of its own. */
#include "earliest.h"
#include "sender.h"

int64_t seam_next_due(struct timers *timers) { return earliest(timers); }
int64_t seam_wakes_at(struct timers *timers) { return atomic_load(&timers->wakes_at); }
/* Have whoever goes through the list of timers crash, or no longer. */
void seam_hide(struct timers *timers, bool hides) {
    static struct timer *first;
    if (hides) first = timers->first;
    timers->first = hides ? (struct timer *)sizeof(void *) : first;
}
/* As if these counters said when endpoints were heard. */
void seam_hear(struct timers *timers, const counter *heard) { timers->heard = heard; }
int seam_timer(struct timers *timers) { return timers->timer; }
void seam_lock(struct timers *timers) { pthread_mutex_lock(&timers->lock); }
void seam_unlock(struct timers *timers) { pthread_mutex_unlock(&timers->lock); }
/* As if somebody had refused what it has sent. */
void seam_refuse(struct sender *sender, int error) { atomic_store(&sender->refused, error); }
