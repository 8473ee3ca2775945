"""Frames: what goes in comes out, and nothing else is taken for a frame."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend import wire
from sim_backend.wire import MalformedFrame, decode_reply, decode_request, encode

N = 3
TORQUE = np.array([1.5, -2.25, 1e-300])
ANSWER = wire.Answer(
    2**62,
    7,
    3,
    np.array([0.1, np.nan, -np.inf]),
    TORQUE,
    np.array([True, False, True]),
    np.array([0, 4, 2**40]),
    (1, 2, 2**32 - 1),
    *np.arange(12.0).reshape(4, N),
)
REQUESTS = [wire.Hello(bytes(range(32))), wire.Enable(), wire.Reset(), wire.Exchange(-5, 1, TORQUE), wire.Stop(1)]
REPLIES = [wire.Welcome(77), wire.Refused(wire.IN_USE, 4), wire.Done(), ANSWER]


def same(one, other):
    assert type(one) is type(other)
    for name in type(one).__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("frame", REQUESTS, ids=lambda frame: type(frame).__name__)
def test_requests_come_out_as_they_went_in(frame):
    number, found = decode_request(encode(frame, 2**33 + 9, N), N)
    assert number == 9
    same(found, frame)


@pytest.mark.parametrize("frame", REPLIES, ids=lambda frame: type(frame).__name__)
def test_replies_come_out_as_they_went_in(frame):
    number, found = decode_reply(encode(frame, 12, N), N)
    assert number == 12
    same(found, frame)
    assert len(encode(frame, 12, N)) <= wire.MAX_BYTES


@pytest.mark.parametrize("text", ["no", "a joint called \N{GREEK SMALL LETTER ALPHA}", "x" * 1000])
def test_errors_arrive_as_text(text):
    _, found = decode_reply(encode(wire.failure_of(ValueError(text)), 1, N), N)
    assert isinstance(found, wire.Failed)
    assert wire.text_of(found) == text[:480]


@pytest.mark.parametrize("frame", REQUESTS + REPLIES, ids=lambda frame: type(frame).__name__)
def test_torn_and_padded_frames_are_refused(frame):
    decode = decode_request if frame in REQUESTS[:2] or isinstance(frame, wire.Exchange | wire.Stop) else decode_reply
    data = encode(frame, 1, N)
    for length in range(len(data)):
        with pytest.raises(MalformedFrame):
            decode(data[:length], N)
    with pytest.raises(MalformedFrame):
        decode(data + b"\0", N)


def changed(frame, place, value):
    data = bytearray(encode(frame, 1, N))
    data[place] = value
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        pytest.param(changed(wire.Enable(), 0, 0), "begins with", id="magic"),
        pytest.param(changed(wire.Enable(), 3, wire.VERSION + 1), "begins with", id="version"),
        pytest.param(changed(wire.Enable(), 4, 99), "no kind 99", id="kind"),
        pytest.param(encode(wire.Exchange(0, 1, np.zeros(4)), 1, 4), "for 4 joints", id="another arm"),
        pytest.param(changed(wire.Enable(), 6, 3), "for 3 joints", id="joints where there are none"),
        pytest.param(encode(wire.Exchange(0, 1, np.array([0, np.nan, 0])), 1, N), "a torque of", id="nan"),
        pytest.param(encode(wire.Exchange(0, 1, np.array([0, 0, np.inf])), 1, N), "a torque of", id="inf"),
        pytest.param(encode(wire.Exchange(0, 2, np.zeros(N)), 1, N), "a torque of", id="sends"),
        pytest.param(encode(wire.Stop(2), 1, N), "no yes or no", id="brakes"),
        pytest.param(encode(wire.Done(), 1, N), "no request", id="reply"),
        pytest.param(b"", "0 bytes", id="nothing"),
    ],
)
def test_what_is_no_request_is_refused(data, message):
    with pytest.raises(MalformedFrame, match=message):
        decode_request(data, N)


def test_what_is_no_reply_is_refused():
    with pytest.raises(MalformedFrame, match="no reply"):
        decode_reply(encode(wire.Enable(), 1, N), N)
    data = bytearray(encode(ANSWER, 1, N))
    data[12 + 24 + 2 * 8 * N] = 2  # the first validity
    with pytest.raises(MalformedFrame, match="no yes or no"):
        decode_reply(bytes(data), N)


@given(st.binary(max_size=400), st.integers(1, 9))
def test_noise_is_refused_or_read_but_never_breaks(data, joints):
    for decode in (decode_request, decode_reply):
        for noise in (data, wire.MAGIC + bytes([wire.VERSION]) + data):
            with suppress(MalformedFrame):
                decode(noise, joints)
