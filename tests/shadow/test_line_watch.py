"""Replies that are missing or damaged, and restarts."""

from dataclasses import replace

import pytest
from twins import SECOND

from khep_twin.log.exchanges import Dialogue, Exchange
from khep_twin.log.shadow_channels import Alarm
from khep_twin.robots.khepera.model import KHEPERA_1
from khep_twin.shadow.line_watch import LOSING, RESTART, LineWatch

SOUND = Exchange(b"N", 0, b"n,1,2,3,4,5,6,7,8", 0)
DAMAGED = replace(SOUND, reply=b"n,1,2,3,4,5,6#7,8")
SILENT = replace(SOUND, reply=None)
UNASKED = Exchange(b"", 0, b"n,1,2", 0)
BANNER = b"ROM of minirobot KHEPERA, version 4.02"


def feed(watch: LineWatch, exchange: Exchange, time_s: float) -> tuple[Alarm, ...]:
    time_ns = round(time_s * SECOND)
    return watch.update(replace(exchange, sent_ns=time_ns, reply_ns=time_ns))


@pytest.mark.parametrize("bad", [DAMAGED, SILENT, UNASKED], ids=["damaged", "silent", "unasked"])
def test_a_line_that_loses_bytes_again_and_again_is_named_until_it_is_sound(bad: Exchange) -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    for tenth in range(20):
        assert feed(watch, bad if tenth % 4 == 0 else SOUND, tenth / 10) == ()
    (alarm,) = watch.alarms
    assert (alarm.fault, alarm.channel, alarm.since_ns) == (LOSING, "line", 0)
    assert alarm.raised_ns < 2 * SECOND
    ended = [alarm for tenth in range(20, 120) for alarm in feed(watch, SOUND, tenth / 10)]
    assert [alarm.fault for alarm in ended] == [LOSING]
    assert 2 * SECOND < (ended[0].ended_ns or 0) < 12 * SECOND
    assert (ended[0].ended_ns or 0) - SECOND < watch.lossy_ns < (ended[0].ended_ns or 0)
    assert watch.alarms == []


@pytest.mark.parametrize(("tenths", "lasts_s"), [(1, 0.6), (5, 2.4), (20, 5.1)])
def test_the_alarm_ends_the_sooner_the_more_was_lost(tenths: int, lasts_s: float) -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    for tenth in range(101):
        feed(watch, DAMAGED if tenth % tenths == 0 else SOUND, tenth / 10)
    ended = [alarm.ended_ns or 0 for tenth in range(101, 200) for alarm in feed(watch, SOUND, tenth / 10)]
    assert ended == [pytest.approx((10 + lasts_s) * SECOND, abs=0.15 * SECOND)]
    assert feed(watch, DAMAGED, 20) == ()
    assert watch.alarms == []  # one that is lost now and then


def test_a_reply_that_is_lost_now_and_then_is_no_fault() -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    for time_s in range(0, 300):
        feed(watch, SILENT if time_s % 30 == 0 else SOUND, time_s)
        assert watch.alarms == []


@pytest.mark.parametrize(
    "exchange",
    [
        replace(SILENT, abandoned=True),
        Exchange(b"", 0, b"Copyright", 0, output_of=BANNER),
        Exchange(b"sens", 0, b"anything", 0),
        Exchange(b"B", 0, b"b,5.02,5.01", 0),
        Exchange(b"J,1,10,0", 0, b"z,Protocol error", 0),
    ],
    ids=["the host left", "output of a banner", "a tool", "versions", "malformed"],
)
def test_what_is_no_loss_is_none(exchange: Exchange) -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    for tenth in range(50):
        feed(watch, exchange, tenth / 10)
        assert watch.alarms == []


def test_a_restart_that_no_host_asked_for_is_shown_for_a_while() -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    exchanges = Dialogue(0).feed(SECOND, False, BANNER + b"\r\nCopyright (C) K-Team\r\n")
    assert len(exchanges) == 2
    for exchange in exchanges:
        watch.update(exchange)
    (alarm,) = watch.alarms
    assert (alarm.fault, alarm.since_ns, alarm.raised_ns) == (RESTART, SECOND, SECOND)
    assert feed(watch, SOUND, 1.1) == ()
    assert watch.alarms
    (ended,) = feed(watch, SOUND, 10)
    assert (ended.fault, ended.ended_ns) == (RESTART, 10 * SECOND)
    assert watch.alarms == []


def test_a_restart_that_a_host_asked_for_is_none() -> None:
    watch = LineWatch(KHEPERA_1.dialect)
    feed(watch, Exchange(b"restart", 0, BANNER, 0), 1)
    assert watch.alarms == []
