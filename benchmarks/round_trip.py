"""Random values of every payload case from UDP to ROS and back to UDP, through two routers, in both directions.

    python -m benchmarks.round_trip --count 100000

Prints what came back different. Exits 1 if anything did, or was lost. All on the loopback interface.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from itertools import islice
from pathlib import Path

# Before anything imports rclpy.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

from tests.acceptance.expected import same_datagram
from tests.acceptance.payloads import WIRE, arbitrary
from tests.acceptance.round_trip import back_to_back, carried, turned
from tests.acceptance.site import Site, total


def differing(case: str, count: int, start: Site, end: Site) -> int:
    """How many of so many random messages of a case did not come back as they had to."""
    # The seed is not that of the tests, which have tried those already.
    random = islice(arbitrary(case, seed=1), count)
    return sum(not same_datagram(arrived, turned(sent)) for sent, arrived in carried(start, end, random))


def run(count: int) -> bool:
    each = -(-count // (2 * len(WIRE.envelopes.first.cases)))
    print(f"{'payload case':22}{'messages':>10}{'different':>11}{'seconds':>9}")
    wrong = 0
    with tempfile.TemporaryDirectory() as folder, back_to_back(Path(folder)) as (left, right):
        for case in WIRE.envelopes.first.cases:
            begin = time.monotonic()
            found = differing(case, each, left, right) + differing(case, each, right, left)
            print(f"{case:22}{2 * each:10}{found:11}{time.monotonic() - begin:9.2f}", flush=True)
            wrong += found
        lost = sum(total(place.scrape(), "messages_dropped") for place in (left, right))
        left_over = sum(len(place.waiting()) for place in (left, right))
    print(f"{'all':22}{2 * each * len(WIRE.envelopes.first.cases):10}{wrong:11}; {lost} dropped")
    return wrong == lost == left_over == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=100_000, help="messages in all; default 100000")
    arguments = parser.parse_args()
    return 0 if run(arguments.count) else 1


if __name__ == "__main__":
    sys.exit(main())
