#include "counters.h"

void counters_join(int64_t *totals, const int64_t *counters, const uint8_t *latest, uint32_t count) {
    for (uint32_t index = 0; index < count; index++) {
        int64_t larger = counters[index] > totals[index] ? counters[index] : totals[index];
        totals[index] = latest[index] ? larger : totals[index] + counters[index];
    }
}
