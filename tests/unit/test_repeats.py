"""Of what comes again and again the log tells the first, then how many came in a minute."""

from __future__ import annotations

import io
import json
import logging
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dgorl.team import json_logs
from dgorl.team.json_logs import JsonLines, Seldom
from dgorl.team.repeats import EVERY, KINDS, Repeats

events = st.lists(st.tuples(st.sampled_from("abc"), st.floats(0.0, 20.0)), max_size=60)


@given(events)
def test_nothing_is_lost_and_little_is_said(gaps: list[tuple[str, float]]) -> None:
    repeats, now = Repeats(), 100.0
    said: dict[str, list[float]] = {}
    told: Counter[str] = Counter()
    for kind, gap in gaps:
        now += gap
        if repeats.first(kind, now):
            said.setdefault(kind, []).append(now)
            told[kind] += 1
        for again, times, within in repeats.due(now):
            assert times > 0
            assert within >= EVERY
            said.setdefault(again, []).append(now)
            told[again] += times
    for again, times, _ in repeats.due(now, all_of_it=True):
        told[again] += times
    assert told == Counter(kind for kind, _ in gaps)
    for stamps in said.values():
        assert all(later - earlier >= EVERY for earlier, later in pairwise(stamps))


def test_it_begins_anew_after_a_quiet_minute() -> None:
    repeats = Repeats()
    assert repeats.first("x", 0.0)
    assert not repeats.first("x", 59.0)
    assert repeats.due(60.0) == [("x", 1, 60.0)]
    assert repeats.due(125.0) == []
    assert repeats.first("x", 126.0)


def test_whoever_thinks_of_ever_new_things_fills_no_memory() -> None:
    repeats = Repeats()
    told = sum(repeats.first(f"kind {k}", 0.0) for k in range(10 * KINDS))
    assert told == KINDS + 1
    assert repeats.due(EVERY) == [(None, 9 * KINDS - 1, EVERY)]


def test_the_log_of_an_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(json_logs.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    handler = Seldom(stream)
    handler.setFormatter(JsonLines("r1"))
    logger = logging.Logger("test")
    logger.addHandler(handler)
    for k in range(500):
        now[0] = k * 0.1
        logger.warning("bad line", extra={"fields": {"line": f"\x1b {k}"}})
        logger.error("not taken", extra={"fields": {"from": "r2"}, "kind": f"r{k % 2}"})
        logger.info("as always")
        handler.tell()
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert Counter(line["event"] for line in lines) == {"bad line": 1, "not taken": 2, "as always": 500}
    stream.truncate(0)
    now[0] = 61.0
    handler.tell()
    handler.tell()
    counts = [json.loads(line) for line in stream.getvalue().strip("\x00").splitlines()]
    assert [(c["level"], c["event"], c["times"], c.get("of")) for c in counts] == [
        ("warning", "bad line", 499, None),
        ("error", "not taken", 249, "r0"),
        ("error", "not taken", 249, "r1"),
    ]
