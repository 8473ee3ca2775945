"""The ring: whatever happens between any two stores, a reader gets what was written, or knows it did not."""

from __future__ import annotations

import os
import random
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ring_actors import record, same, store

from ident_service.errors import UsageError
from ident_service.recordings import ring_buffer as ring_memory
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.ring_buffer import Closed, EventRecord, RingReader, RingWriter, create_ring, slot_bytes

Store = tuple[int, bytes]


@pytest.fixture
def ring() -> Iterator[Callable[..., int]]:
    with rings() as make:
        yield make


@contextmanager
def rings() -> Iterator[Callable[..., int]]:
    made = []

    def make(joints: int = 3, slots: int = 4) -> int:
        made.append(create_ring(joints, slots))
        return made[-1]

    yield make
    for fd in made:
        os.close(fd)


class Logged:
    """What a writer stores into, noting each store; throws before or after a chosen one, once."""

    def __init__(self, target: object, log: list[Store], fail: list[tuple[int, bool]]) -> None:
        self.target, self.log, self.fail = target, log, fail

    def __getitem__(self, place: object) -> object:
        return self.target[place]  # type: ignore[index]

    def __setitem__(self, place: int | slice, value: object) -> None:
        number = len(self.log)
        self._throw(number, False)
        begin = place.start if isinstance(place, slice) else 8 * place
        self.log.append((begin, bytes(value) if isinstance(place, slice) else value.to_bytes(8, "little")))
        self.target[place] = value  # type: ignore[index]
        self._throw(number, True)

    def _throw(self, number: int, after: bool) -> None:
        if (number, after) in self.fail:
            self.fail.clear()
            raise KeyboardInterrupt


def logged(fd: int, *fail: tuple[int, bool]) -> tuple[RingWriter, list[Store]]:
    writer, log, fails = RingWriter(fd), [], list(fail)
    writer._words = Logged(writer._words, log, fails)
    writer._content = Logged(writer._content, log, fails)
    return writer, log


def stores(make: Callable[..., int], count: int) -> list[Store]:
    """Every store of `count` records, in order, for a ring of 4 slots; the heartbeat is nobody's truth."""
    writer, log = logged(make())
    for n in range(count):
        store(writer, n)
    writer.memory.close()
    return [(begin, data) for begin, data in log if begin != 8 * ring_memory.WRITER_HEARTBEAT]


def written(log: list[Store]) -> int:
    """How many records have got their final sequence."""
    return sum(
        begin >= ring_memory.HEADER_BYTES and len(data) == 8 and not int.from_bytes(data, "little") & 1
        for begin, data in log
    )


def read_rest(reader: RingReader) -> int:
    """Read all there is and check each record; the number of records read."""
    count = 0
    while (found := reader.read()) is not None:
        assert same(found, record(reader.cursor - 1))
        count += 1
    assert reader.cursor == reader.returned + reader.lost
    return count


def test_records_survive_to_the_bit(ring: Callable[..., int]) -> None:
    for joints in (1, 7, 64):
        fd = ring(joints, 64)
        writer = RingWriter(fd)
        with RingReader(fd) as reader, RingReader(fd, recorder=True) as second:
            for n in range(50):
                store(writer, n, joints)
            for one in (reader, second):
                for n in range(50):
                    found = one.read()
                    assert found is not None
                    assert same(found, record(n, joints))
                assert one.read() is None
                assert (one.returned, one.lost, one.cursor) == (50, 0, 50)
        writer.memory.close()


def test_any_bits_of_a_float_survive(ring: Callable[..., int]) -> None:
    fd = ring(3, 4)
    writer = RingWriter(fd)
    bits = np.array([0x7FF0000000000001, 0xFFF8123456789ABC, 0x8000000000000000], np.uint64)
    q, flags, ages = bits.view(np.float64), np.ones(3, bool), np.array([-1, 2**62, 0])
    extreme = Cycle(-(2**63), q, q, q, q, q, 2**63 - 1, -1, -2, flags, ages, 7)
    writer.put(extreme)
    with RingReader(fd) as reader:
        found = reader.read()
        assert isinstance(found, Cycle)
        assert same(found, extreme)
        assert not found.position.flags.writeable
    writer.memory.close()


def test_long_messages_are_cut_and_say_so(ring: Callable[..., int]) -> None:
    fd = ring(1, 64)
    writer = RingWriter(fd)
    room = slot_bytes(1) - 8 - 32
    texts = ["", "plain", "x" * room, "x" * (room + 1), "ä" * room, "€" * room, "lone \ud800 surrogate"]
    for text in texts:
        writer.event(1, 30, text)
    with RingReader(fd) as reader:
        found = [reader.read() for _ in texts]
    messages = [one.message for one in found if isinstance(one, EventRecord)]
    assert messages[:3] == texts[:3]
    for text, message in zip(texts[3:6], messages[3:6], strict=True):
        assert message.endswith(" [cut]")
        assert text.startswith(message.removesuffix(" [cut]"))
        assert room - 4 <= len(message.encode()) <= room
    assert messages[6] == "lone \\ud800 surrogate"
    writer.memory.close()


def test_overruns_are_counted(ring: Callable[..., int]) -> None:
    fd = ring(3, 16)
    writer = RingWriter(fd)
    with RingReader(fd) as reader:
        for n in range(100):
            store(writer, n)
        late = RingReader(fd, from_now=True)
        assert read_rest(reader) == 12  # a quarter of the ring is given up, so as not to be overrun again at once
        assert reader.lost == 88
        assert late.read() is None
        store(writer, 100)
        assert (read_rest(reader), reader.cursor) == (1, 101)
        assert same(late.read(), record(100))
        late.memory.close()
    writer.memory.close()


def test_the_end_is_reported(ring: Callable[..., int]) -> None:
    for finished, expected in ((True, Closed.FINISHED), (False, Closed.ENDED_EARLY)):
        fd = ring()
        writer = RingWriter(fd)
        with RingReader(fd) as reader:
            assert reader.closed is Closed.OPEN
            assert reader.writer_pid == os.getpid()
            before = reader.writer_heartbeat_ns
            store(writer, 0)
            assert before < reader.writer_heartbeat_ns <= time.monotonic_ns()
            assert writer.close(finished=finished)
            assert not writer.close(finished=not finished)
            assert reader.closed is expected
        writer.memory.close()


def test_one_writer_and_one_recorder(ring: Callable[..., int]) -> None:
    fd = ring()
    writer = RingWriter(fd)
    with pytest.raises(UsageError, match=f"has a writer already, process {os.getpid()}"):
        RingWriter(fd)
    with RingReader(fd, recorder=True), pytest.raises(UsageError, match="has a recorder already"):
        RingReader(fd, recorder=True)
    writer.memory.close()
    writer.memory.close()


def test_wrong_values_are_refused_and_leave_no_record(ring: Callable[..., int]) -> None:
    fd = ring()
    writer = RingWriter(fd)
    good = record(1)
    assert isinstance(good, Cycle)
    for name, value in (
        ("position", np.zeros(2)),
        ("velocity", np.zeros(4)),
        ("torque", np.float64(1.0)),
        ("valid", np.ones((3, 1))),
        ("age", np.ones(1)),
        ("position", np.zeros(3, dtype=np.int64)),  # its bytes would be other numbers
        ("age", np.zeros(3, dtype=np.int32)),
    ):
        with pytest.raises(ValueError, match="but the ring has 3 joints"):
            writer.put(good._replace(**{name: value}))
    # The last is how Python words it since 3.12.
    with pytest.raises((struct.error, OverflowError), match=r"int too large|argument out of range|format requires"):
        writer.put(good._replace(cycle=2**70))
    with RingReader(fd) as reader:
        assert reader.read() is None
        for n in range(2):
            store(writer, n)
        assert read_rest(reader) == 2
    writer.memory.close()


def test_foreign_memory_is_refused(tmp_path: Path, ring: Callable[..., int]) -> None:
    (tmp_path / "file").write_bytes(bytes(10_000))
    with (tmp_path / "file").open("r+b") as stream, pytest.raises(UsageError, match="not the memory of a ring"):
        RingReader(stream.fileno())
    foreign = os.memfd_create("other")
    os.ftruncate(foreign, 100_000)
    with pytest.raises(UsageError, match="not the memory of a ring"):
        RingWriter(foreign)
    os.close(foreign)
    with pytest.raises(UsageError, match="not the memory of a ring: Bad file"):
        RingReader(foreign)
    for place, message in ((0, "does not begin"), (8, "version"), (16, "damaged"), (40, "damaged"), (48, "damaged")):
        fd = ring()
        os.pwrite(fd, b"\x63", place)
        with pytest.raises(UsageError, match=message):
            RingReader(fd)
    with pytest.raises(OSError, match="not permitted"):
        os.ftruncate(ring(), 0)
    for joints, slots in ((0, 8), (65, 8), (3, 3), (3, 1 << 21)):
        with pytest.raises(UsageError, match="but a ring has"):
            create_ring(joints, slots)


def test_a_writer_that_dies_between_any_two_stores(ring: Callable[..., int]) -> None:
    log = stores(ring, 11)
    chance = random.Random(1)  # noqa: S311
    for cut in range(len(log) + 1):
        begin, last = log[cut] if cut < len(log) else (0, b"")
        # The copy into the slot has no order of its own: any subset of its bytes may have got there.
        halves = [b""] if len(last) <= 8 else [b"", last[: len(last) // 2], last[:1], last[:-1], last]
        for half in halves:
            for every in (1, 5, 10_000):
                fd = ring()
                with RingReader(fd) as reader:
                    for k, (place, data) in enumerate(log[:cut]):
                        os.pwrite(fd, data, place)
                        if k % every == 0:
                            read_rest(reader)
                    os.pwrite(fd, half, begin)
                    for _ in range(len(half) and 3):
                        place = chance.randrange(len(last))
                        os.pwrite(fd, last[place : place + 1], begin + place)
                    read_rest(reader)
                    assert reader.cursor == written(log[:cut])
                    assert every > 1 or reader.lost == 0


@pytest.mark.parametrize("after", [False, True])
def test_a_writer_torn_out_of_put_goes_on(ring: Callable[..., int], after: bool) -> None:
    """A signal's exception ends one `put`; every other record arrives, also where the loop goes on with another one."""
    for place in range(4, 40):
        fd = ring(3, 16)
        writer, _ = logged(fd, (place, after))
        arrived: list[int] = []
        put: list[int] = []
        with RingReader(fd) as reader:
            for n in range(10):
                try:
                    writer.event(n, 20, str(n))
                    put.append(n)
                except KeyboardInterrupt:
                    pass
                while (found := reader.read()) is not None:
                    arrived.append(found.stamp_ns)
            assert reader.cursor == reader.returned + reader.lost == writer.written
            assert reader.lost <= 1
        assert set(put) <= set(arrived)
        assert arrived == sorted(set(arrived))
        writer.memory.close()


class Racing:
    """What a reader loads from; before each load, and in the middle of a copy, the writer gets on."""

    def __init__(self, target: object, step: Callable[[], None]) -> None:
        self.target, self.step = target, step

    def __getitem__(self, place: int | slice) -> object:
        self.step()
        if not isinstance(place, slice):
            return self.target[place]  # type: ignore[index]
        middle = (place.start + place.stop) // 2
        first = self.target[place.start : middle]  # type: ignore[index]
        self.step()
        return first + self.target[middle : place.stop]  # type: ignore[index]


@pytest.mark.slow
@settings(max_examples=150)
@given(st.integers(0, 2**32), st.sampled_from([0, 1, 2, 5, 30]))
def test_a_reader_that_races_the_writer(seed: int, most: int) -> None:
    chance = random.Random(seed)  # noqa: S311
    with rings() as make:
        pending = iter(in_pieces(stores(make, 40), chance))
        fd = make()

        def step() -> None:
            for place, data in islice(pending, chance.randint(0, most)):
                os.pwrite(fd, data, place)

        with RingReader(fd) as reader:
            reader._words, reader._content = Racing(reader._words, step), Racing(reader._content, step)
            for _ in range(200):
                read_rest(reader)
            for place, data in pending:
                os.pwrite(fd, data, place)
            read_rest(reader)
            assert reader.cursor == 40


def in_pieces(log: list[Store], chance: random.Random) -> list[Store]:
    """The same stores, but the copies into slots in four parts, which have no order."""
    pieces: list[Store] = []
    for begin, data in log:
        cuts = [] if len(data) == 8 else sorted(chance.randrange(len(data)) for _ in range(3))
        parts = [(begin + a, data[a:b]) for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
        chance.shuffle(parts)
        pieces += parts
    return pieces


@settings(max_examples=100)
@given(st.integers(0, 2**32))
def test_no_order_of_stores_makes_a_wrong_record(seed: int) -> None:
    """What a machine with a weak order of stores could show: not every record, but never a wrong one."""
    chance = random.Random(seed)  # noqa: S311
    with rings() as make:
        log, fd = in_pieces(stores(make, 12), chance), make()
        # Within a window, any store may overtake any other.
        order = sorted(range(len(log)), key=lambda k: k + chance.uniform(0, 20))
        with RingReader(fd) as reader:
            for k in order:
                os.pwrite(fd, log[k][1], log[k][0])
                read_rest(reader)
            assert reader.cursor >= 4
