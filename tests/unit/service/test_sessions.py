"""Sessions begin when they are named, end when nobody uses them, and give each caller a bounded part."""

import asyncio

import pytest

from sceneloom.db34t.interface import FusionInterface
from sceneloom.errors import DataError
from sceneloom.service.sessions import CallError, SessionTable
from sceneloom.service.startup import ServiceLimits


class Clock:
    """Seconds that go on when they are reported to."""

    now_s = 1000.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


def with_table(examine, clock, **limits):
    """Run a coroutine that examines a table of sessions."""

    async def run():
        table = SessionTable(
            lambda name, on_result: FusionInterface(on_result=on_result), ServiceLimits(**limits), clock=clock
        )
        try:
            await examine(table)
        finally:
            await table.end_all(30)
            table.close()

    asyncio.run(run())


def test_a_session_that_nobody_uses_ends_after_its_time_and_not_before(clock):
    async def examine(table):
        idle, used, waiting = (table.named(name) for name in ("idle", "used", "waiting"))
        with waiting.request(0, clock):
            clock.now_s += 119.9
            with used.request(0, clock):
                pass
            assert table.end_idle() == []
            clock.now_s += 0.1
            assert table.end_idle() == ["idle"]
            clock.now_s += 1000
            assert table.end_idle() == ["used"]
        assert table.end_idle() == []  # its request has just ended
        clock.now_s += 120
        assert table.end_idle() == ["waiting"]
        assert len(table) == 0
        assert table.named("idle") is not idle

    with_table(examine, clock, idle_minutes=2)


def test_sessions_that_are_ending_count_until_they_have_ended(clock):
    async def examine(table):
        table.named("a")
        clock.now_s += 10_000
        assert table.end_idle() == ["a"]
        with pytest.raises(CallError, match="as many as there may be"):
            table.named("b")

    with_table(examine, clock, most_sessions=1)


def test_a_session_that_names_none_is_the_default_one(clock):
    async def examine(table):
        assert table.named("") is table.named("default")
        assert table.take("").name == "default"
        assert table.take("") is None

    with_table(examine, clock)


def test_requests_that_wait_may_hold_so_many_bytes(clock):
    async def examine(table):
        session = table.named("a")
        with session.request(60, clock):
            with pytest.raises(CallError, match="60 bytes of session 'a' wait; expected at most 100"):
                session.request(41, clock).__enter__()
            with session.request(40, clock):
                pass
        with session.request(100, clock):
            pass

    with_table(examine, clock, most_bytes_waiting=100)


def test_a_result_wakes_those_who_wait_for_it_and_an_end_all_of_them(clock):
    async def examine(table):
        session = table.named("a")
        waiting = [asyncio.ensure_future(session.next_result(kind, None)) for kind in (0, 1)]
        await asyncio.sleep(0)
        assert not any(one.done() for one in waiting)
        await session.end()
        assert await asyncio.gather(*waiting) == [None, None]

    with_table(examine, clock)


@pytest.mark.parametrize(
    ("table", "location", "words"),
    [
        ({"sessions": 3}, "service.sessions", "unknown; expected one of most_sessions"),
        ({"most_sessions": 0}, "service.most_sessions", "0; expected a whole number above 0"),
        ({"most_sessions": 1.5}, "service.most_sessions", "1.5; expected a whole number above 0"),
        ({"most_sessions": True}, "service.most_sessions", "True; expected a whole number"),
        ({"idle_minutes": float("nan")}, "service.idle_minutes", "nan; expected a number above 0"),
        ({"idle_minutes": "1"}, "service.idle_minutes", "'1'; expected a number above 0"),
    ],
)
def test_a_limit_that_is_none_is_reported_with_its_location(table, location, words):
    with pytest.raises(DataError, match=f"rig.toml: {location}: {words}"):
        ServiceLimits.of(table, file="rig.toml", location="service")


def test_limits_are_read_from_a_table():
    assert ServiceLimits.of({"most_sessions": 3, "idle_minutes": 1}) == ServiceLimits(
        most_sessions=3, idle_minutes=1
    )
