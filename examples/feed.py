"""Feed an agent from a program of yours: odometry and ranges in over its loopback session, estimates out.

    dgorl agent --robot r1 --team team.yaml --key r1.key --local tcp/127.0.0.1:7448 &
    python examples/feed.py --robot r1 --seconds 10

In place of `drive` and `hear` stands what your wheels and radio say. Any language with Zenoh does; without it, write
the same lines to the agent's stdin (`--stdin`).
"""

from __future__ import annotations

import argparse
import json
import time

import zenoh

PERIOD = 0.1


def drive(start: float, end: float) -> dict[str, object]:
    """The twist of the last tenth of a second: here, a circle."""
    return {"type": "odometry", "start": start, "end": end, "v": 0.3, "omega": 0.2}


def hear(stamp: float, peer: str) -> dict[str, object]:
    """A range to a peer, as a UWB module gives it: here, always the same."""
    return {"type": "range", "stamp": stamp, "peer": peer, "range": 2.0, "sigma": 0.1}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="r1")
    parser.add_argument("--peer", default="r2")
    parser.add_argument("--endpoint", default="tcp/127.0.0.1:7448")
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [arguments.endpoint],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        session.declare_subscriber(
            f"local/{arguments.robot}/estimate", lambda sample: print(sample.payload.to_string(), flush=True)
        )
        measurements = session.declare_publisher(f"local/{arguments.robot}/measurements")
        last = time.time()
        until = last + arguments.seconds
        while last < until:
            time.sleep(PERIOD)
            now = time.time()
            lines = [drive(last, now), hear(now, arguments.peer)]
            measurements.put("\n".join(json.dumps(line) for line in lines))
            last = now


if __name__ == "__main__":
    main()
