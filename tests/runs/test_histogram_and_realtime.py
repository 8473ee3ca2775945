"""Times in fixed bins, and what the kernel grants."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ident_service.motion.histogram import Histogram


@given(times=st.lists(st.integers(0, 10**9), min_size=1, max_size=200), share=st.sampled_from([0.5, 0.99, 0.999]))
def test_a_share_of_all_times_is_below_what_it_says(times: list[int], share: float) -> None:
    histogram = Histogram()
    for time in times:
        histogram.add(time)
    assert histogram.count == len(times)
    assert histogram.worst_ns == max(times)
    assert np.mean(np.array(times) <= histogram.below_us(share) * 1e3 + 1e-6) >= share
    assert sum(histogram.document()["counts"]) == len(times)


def test_nothing_was_counted_yet() -> None:
    assert Histogram().below_us(0.999) == 0.0


def test_what_is_asked_of_the_kernel_is_answered_in_words_and_nothing_fails() -> None:
    code = (
        "from ident_service.motion.realtime import ask; granted = ask(); print(granted.sentence()); "
        "import gc; assert not gc.isenabled(); assert granted.collector"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("real time: got ")
