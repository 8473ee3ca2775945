"""A lease over standard input: renewed by lines, ended by silence, by the end of the input, by the word `stop`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress

import pytest

from ident_service.cli.operator_input import StdinLease


class _Clock:
    seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    for fd in (reading, writing):
        with suppress(OSError):
            os.close(fd)


def test_lines_keep_it_and_silence_ends_it(pipe: tuple[int, int]) -> None:
    clock = _Clock()
    lease = StdinLease(2.0, pipe[0], clock)
    for _ in range(5):
        assert not lease.over()
        clock.seconds += 1.9
        os.write(pipe[1], b"\n")
    assert not lease.over()
    clock.seconds += 2.0
    assert not lease.over()
    clock.seconds += 0.01
    assert lease.over()
    assert "2 s" in lease.reason


def test_what_is_over_stays_over(pipe: tuple[int, int]) -> None:
    clock = _Clock()
    lease = StdinLease(0.25, pipe[0], clock)
    assert not lease.over()
    clock.seconds += 0.3
    assert lease.over()
    os.write(pipe[1], b"\n")
    assert lease.over()


def test_half_a_line_renews_nothing(pipe: tuple[int, int]) -> None:
    clock = _Clock()
    lease = StdinLease(1.0, pipe[0], clock)
    assert not lease.over()
    clock.seconds += 0.9
    os.write(pipe[1], b"sto")
    assert not lease.over()
    clock.seconds += 0.2
    assert lease.over()


@pytest.mark.parametrize("words", [b"stop\n", b"\n\nstop\n\n", b"  stop \n"])
def test_stop_is_a_stop(pipe: tuple[int, int], words: bytes) -> None:
    lease = StdinLease(1e9, pipe[0], _Clock())
    assert not lease.over()
    os.write(pipe[1], words)
    assert lease.over()
    assert "stop" in lease.reason


def test_a_stop_in_two_pieces_is_one(pipe: tuple[int, int]) -> None:
    lease = StdinLease(1e9, pipe[0], _Clock())
    os.write(pipe[1], b"st")
    assert not lease.over()
    os.write(pipe[1], b"op\n")
    assert lease.over()


def test_the_end_of_the_input_is_a_stop(pipe: tuple[int, int]) -> None:
    lease = StdinLease(1e9, pipe[0], _Clock())
    os.write(pipe[1], b"\n")
    assert not lease.over()
    os.close(pipe[1])
    assert lease.over()
    assert "has ended" in lease.reason


def test_a_flood_does_not_keep_us(pipe: tuple[int, int]) -> None:
    lease = StdinLease(1.0, pipe[0], _Clock())
    os.write(pipe[1], b"x" * 60_000)
    assert not lease.over()
