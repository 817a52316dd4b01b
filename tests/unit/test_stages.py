"""Stages of a job: each moment counts once, for the innermost."""

import threading

import pytest

from sceneloom import stages
from sceneloom.stages import stage, timed


@pytest.fixture
def clock(monkeypatch):
    """A clock that only `pass_` moves."""
    now = [0.0]
    monkeypatch.setattr(stages.time, "perf_counter", lambda: now[0])

    def pass_(seconds):
        now[0] += seconds

    return pass_


def test_each_moment_counts_for_the_innermost_stage(clock):
    with timed() as found:
        clock(100.0)
        with stage("fusing"):
            clock(1.0)
            for _ in range(2):
                with stage("reading"):
                    clock(0.25)
            clock(2.0)
        with stage("reading"):
            clock(8.0)
    assert found == {"fusing": 3.0, "reading": 8.5}


def test_what_fails_is_counted_and_ends_its_stage(clock):
    with timed() as found:
        with pytest.raises(ValueError, match="no"), stage("reading"):
            clock(1.0)
            raise ValueError("no")
        with stage("writing"):
            clock(2.0)
    assert found == {"reading": 1.0, "writing": 2.0}


def test_who_asks_around_is_reported_once(clock):
    with timed() as outer, stage("report"):
        clock(1.0)
        with timed() as inner:
            clock(0.5)
            with stage("checking"):
                clock(4.0)
    assert inner == {"checking": 4.0}
    assert outer == {"report": 1.5, "checking": 4.0}


def test_nobody_asked_and_other_threads_count_nothing(clock):
    with stage("reading"):
        clock(1.0)

    def other():
        with stage("elsewhere"):
            clock(1.0)

    with timed() as found:
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert found == {}
