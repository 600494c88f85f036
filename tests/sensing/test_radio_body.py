"""The radios of several robots, period by period: receivers, times and order of the messages."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from radio_scene import Air, Message, playpen_with_radios

from khep_twin.board.radio import CAPACITY, TRANSMISSIONS, RadioRegister
from khep_twin.units import RADIO_ALL, TICK_NS, RadioStatus
from khep_twin.world import World

N_ROBOTS = 4


@pytest.fixture(scope="module")
def world() -> World:
    return World(playpen_with_radios([(100, 250), (200, 250), (400, 250), (500, 250)]))


def run(
    air: Air, count: int, seed: int, receivers: Sequence[int], shuffled: bool = False
) -> tuple[Counter, dict]:
    """Send random messages from all radios; return the counts by sender and the messages by receiver."""
    rng, order = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    sent: Counter[int] = Counter()
    arrived: dict[int, list[Message]] = defaultdict(list)
    failed = 0
    for _ in range(100 * count):
        if sum(sent.values()) >= count and all(air.status(number) & 1 for number in range(1, 5)):
            break
        for number in range(1, N_ROBOTS + 1):
            if sum(sent.values()) < count and air.status(number) & RadioStatus.READY and rng.random() < 0.5:
                failed += bool(air.status(number) & RadioStatus.FAILED)
                goal = int(rng.choice([other for other in receivers if other != number]))
                data = sent[number].to_bytes(4, "little") + rng.bytes(int(rng.integers(13)))
                assert air.send(number, goal, data)
                sent[number] += 1
        air.tick(order.permutation(N_ROBOTS).tolist() if shuffled else range(N_ROBOTS))
        for number in range(1, N_ROBOTS + 1):
            arrived[number] += air.read(number)
    failed += sum(bool(air.status(number) & RadioStatus.FAILED) for number in range(1, N_ROBOTS + 1))
    sent[0] = failed
    return sent, arrived


def senders(arrived: Sequence[Message]) -> Iterator[tuple[int, list[int]]]:
    """Yield each sender with the numbers of its messages that arrived at a radio."""
    for sender in range(1, N_ROBOTS + 1):
        numbers = [
            int.from_bytes(message.data[:4], "little") for message in arrived if message.sender == sender
        ]
        yield sender, numbers


@pytest.mark.share(2)
@pytest.mark.parametrize("count", [1000, 10_000])
def test_each_message_is_delivered_at_most_once_and_in_the_order_of_its_sender(
    world: World, count: int
) -> None:
    air = Air(world, seed=3, loss=0.5)
    sent, arrived = run(air, count, seed=1, receivers=range(1, 5))
    failed = sent.pop(0)
    assert sent.total() == count
    delivered: Counter[tuple[int, int]] = Counter()
    for messages in arrived.values():
        for sender, numbers in senders(messages):
            assert numbers == sorted(set(numbers))
            delivered.update((sender, number) for number in numbers)
    assert max(delivered.values()) == 1
    # Every sender knows which of its messages were lost: no acknowledgement in four transmissions.
    assert delivered.total() + failed == count
    assert failed / count == pytest.approx(0.5**TRANSMISSIONS, abs=4 * (0.0625 * 0.9375 / count) ** 0.5)


@pytest.mark.share(6)
@pytest.mark.parametrize(
    ("loss", "count"), [(0.3, 500), *((loss, 2000) for loss in (0.0, 0.02, 0.3, 0.9, 1.0))]
)
def test_a_transmission_is_lost_to_each_receiver_as_often_as_the_playpen_has_it(
    world: World, loss: float, count: int
) -> None:
    air = Air(world, seed=5, loss=loss)
    sent, arrived = run(air, count, seed=2, receivers=[RADIO_ALL])
    assert sent[0] == 0
    share_received = sum(map(len, arrived.values())) / (count * (N_ROBOTS - 1))
    assert share_received == pytest.approx(1 - loss, abs=4 * (loss * (1 - loss) / (3 * count)) ** 0.5)
    # One receiver's luck is not that of the others.
    if 0 < loss < 1:
        [(_, first)] = [received for received in senders(arrived[3]) if received[0] == 1]
        [(_, second)] = [received for received in senders(arrived[4]) if received[0] == 1]
        received_by_both = len(set(first) & set(second)) / sent[1]
        assert received_by_both == pytest.approx((1 - loss) ** 2, abs=4 * (0.25 / sent[1]) ** 0.5)


@pytest.mark.share(2)
@pytest.mark.parametrize("count", [100, 300])
def test_the_same_seed_gives_the_same_registers_and_another_seed_others(world: World, count: int) -> None:
    outcomes = []
    for seed in (7, 7, 8):
        air = Air(world, seed=seed, loss=0.4)
        outcome = run(air, count, seed=3, receivers=[1, 2, 3, 4, RADIO_ALL])
        outcomes.append((outcome, air.registers()))
    assert outcomes[0] == outcomes[1]
    assert outcomes[0] != outcomes[2]


@pytest.mark.share(2)
@pytest.mark.parametrize("count", [200, 1000])
def test_the_order_in_which_the_robots_of_a_period_run_changes_nothing(world: World, count: int) -> None:
    outcomes = []
    for shuffled in (False, True):
        air = Air(world, seed=7, loss=0.4)
        outcome = run(air, count, seed=4, receivers=[1, 2, 3, 4, RADIO_ALL], shuffled=shuffled)
        outcomes.append((outcome, air.registers()))
    assert outcomes[0] == outcomes[1]


@pytest.mark.parametrize(
    ("range_mm", "reached"), [(99.9, []), (100.1, [2]), (300.1, [2, 3]), (1000, [2, 3, 4])]
)
def test_a_message_arrives_as_far_as_the_range(world: World, range_mm: float, reached: list[int]) -> None:
    air = Air(world, range_mm=range_mm)
    air.send(1, RADIO_ALL, b"all")
    for _ in range(10):
        air.tick()
    assert [number for number in range(1, 5) if air.read(number)] == reached
    air.send(1, 3, b"three")
    for _ in range(40):
        air.tick()
    assert bool(air.read(3)) == (3 in reached)
    assert air.status(1) == (RadioStatus.READY if 3 in reached else RadioStatus.READY | RadioStatus.FAILED)


@pytest.mark.parametrize(("air_time_ms", "periods"), [(0.1, 1), (10, 1), (10.1, 2), (30, 3), (200, 20)])
def test_a_message_is_in_the_air_for_its_time_and_ready_a_period_later(
    world: World, air_time_ms: float, periods: int
) -> None:
    air = Air(world, air_time_ms=air_time_ms)
    air.send(1, 2, b"hello")
    air.tick()
    for _ in range(periods):
        assert not air.status(2) & RadioStatus.RECEIVED
        air.tick()
    assert air.read(2) == [Message(1, b"hello")]
    assert not air.status(1) & RadioStatus.READY
    air.tick()
    assert air.status(1) == RadioStatus.READY


def test_a_message_that_nobody_takes_is_sent_four_times_and_fails(world: World) -> None:
    for to in (0, 1, 5, 255):
        air = Air(world)
        air.send(1, to, b"?")
        ticks = 0
        while not air.status(1) & RadioStatus.READY:
            air.tick()
            ticks += 1
        assert air.status(1) == RadioStatus.READY | RadioStatus.FAILED
        assert air.electronics[0].registers[RadioRegister.TRANSMISSIONS] == TRANSMISSIONS
        assert ticks == 1 + TRANSMISSIONS * 4
        assert not any(air.read(number) for number in range(1, 5))


def test_messages_that_arrive_together_are_read_in_the_order_of_their_senders(world: World) -> None:
    air = Air(world)
    for sender in (3, 1, 2):
        air.send(sender, 4, b"%d" % sender)
    for _ in range(5):
        air.tick([3, 2, 1, 0])
    assert air.read(4) == [Message(sender, b"%d" % sender) for sender in (1, 2, 3)]


def test_a_full_buffer_refuses_until_a_message_is_read(world: World) -> None:
    air = Air(world)
    for number in range(CAPACITY + 1):
        air.send(1, 2, bytes([number]))
        for _ in range(5):
            air.tick()
    assert air.status(2) == RadioStatus.READY | RadioStatus.RECEIVED | RadioStatus.OVERRUN
    assert not air.status(1) & RadioStatus.READY
    air.electronics[1].receive(b"R")
    while not air.status(1) & RadioStatus.READY:
        air.tick()
    # It was repeated, and found room.
    assert air.status(1) == RadioStatus.READY
    assert [message.data for message in air.read(2)] == [bytes([number]) for number in range(1, CAPACITY + 1)]


def test_a_turret_without_power_neither_sends_nor_receives(world: World) -> None:
    air = Air(world)
    air.send(1, 2, b"hello")
    air.send(2, 1, b"hello")
    air.tick([0, 2, 3])
    air.electronics[1].reset()  # as the board does at a loss of power
    for _ in range(30):
        air.time_ns += TICK_NS
        for robot in (0, 2, 3):
            air.electronics[robot].tick()
        for body in air.bodies:
            body.drive()
    assert air.status(1) == RadioStatus.READY | RadioStatus.FAILED
    assert air.status(2) == RadioStatus.READY


@pytest.mark.share(2)
@pytest.mark.parametrize("snapshots", [40, 200])
def test_registers_out_of_a_damaged_snapshot_are_no_error(world: World, snapshots: int) -> None:
    rng = np.random.default_rng(6)
    extremes = np.array([-(2**63), -1, 0, 1, 2, 5, 255, TICK_NS, 2**63 - 1])
    for _ in range(snapshots):
        air = Air(world, loss=0.5)
        for electronics in air.electronics:
            electronics.registers[:] = rng.choice(extremes, len(electronics.registers))
        for _ in range(3):
            air.tick()
        for number, electronics in enumerate(air.electronics, 1):
            assert air.send(number, 1, b"?") in (True, False)
            for message in (b"F", b"R", b"B"):
                assert electronics.receive(message).startswith(b"t,4,")
