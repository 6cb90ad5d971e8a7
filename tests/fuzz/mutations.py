"""A flood of mutated real messages against one robot's gossip: counted by reason, without effect, in bounded memory.

    python -m tests.fuzz.mutations --messages 1000000

Three robots talk; what two of them said is sent to the third with bytes flipped, cut out, doubled or moved between
messages. Asked: no exception, nothing of it reaches its state, its memory does not grow.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random

from dgorl.team.gossip import Reaction
from dgorl.team.voice import Outgoing

from ..team_network import Network, Robot

SPACING = 0.1
"""Seconds between two messages: fewer than the rate limit stops, so that all are looked at."""
SAID = 5.0
"""For so long [s] the robots talk before."""

Message = tuple[str, str, bytes]
"""channel, sender, payload"""


def mutations(messages: Sequence[Message], count: int, seed: int) -> Iterator[Message]:
    """So many of them, each changed in one to four places; those that came out as they were are left out."""
    random = Random(seed)
    for _ in range(count):
        channel, sender, payload = random.choice(messages)
        changed = bytearray(payload)
        for _ in range(random.randint(1, 4)):
            at = random.randrange(len(changed))
            match random.randrange(4):
                case 0:
                    changed[at] ^= 1 << random.randrange(8)
                case 1:
                    del changed[at : at + random.randint(1, 20)]
                case 2:
                    changed[at:at] = changed[at : at + random.randint(1, 20)]
                case 3:
                    other = random.choice(messages)[2]
                    changed[at : at + 20] = other[at : at + 20]
            changed = changed or bytearray(b"\0")
        if bytes(changed) != payload:
            yield channel, sender, bytes(changed)


def overheard(network: Network, robot: str) -> list[Message]:
    """What the others say while the network goes on for a while."""
    sent: list[tuple[str, Outgoing]] = []
    network.taps.append(lambda sender, out: sent.append((sender, out)))
    network.run(SAID)
    network.taps.pop()
    return [(out.channel, sender, out.payload) for sender, out in sent if sender != robot]


def told(robot: Robot, messages: Iterator[Message], now: float) -> Counter[str]:
    """What a robot counts for them, by reason; none of them makes it do anything."""
    before = Counter(robot.gossip.rejected)
    for k, (channel, sender, payload) in enumerate(messages):
        assert robot.gossip.receive(channel, sender, payload, now + SPACING * k) == Reaction(), (channel, payload)
    return Counter({str(reason): count for reason, count in (robot.gossip.rejected - before).items()})


def resident() -> float:
    """Memory of this process [MB]; Linux."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def main() -> None:
    """Print what was counted, and the memory, ten times on the way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    network = Network(3, signed=True)
    network.start(*network.names)
    network.run(6.0)
    messages, robot = overheard(network, "r1"), network.robots["r1"]
    holds, counted, now = robot.gossip.holds(), Counter[str](), network.now
    part = max(given.messages // 10, 1)
    print(f"{len(messages)} messages overheard; {resident():.1f} MB")
    began = time.process_time()
    for k in range(-(-given.messages // part)):
        count = min(part, given.messages - k * part)
        counted += told(robot, mutations(messages, count, given.seed + k), now)
        now += SPACING * count
        print(
            f"{counted.total()} rejected, {resident():.1f} MB, {time.process_time() - began:.0f} s of CPU", flush=True
        )
    assert robot.gossip.holds() == holds
    for reason, number in counted.most_common():
        print(f"{reason:20} {number}")


if __name__ == "__main__":
    main()
