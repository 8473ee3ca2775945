"""`ident doctor`: what is said of a kernel, a user's limits and an interface, and which rates a computer can hold."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.arm import Watchdog
from ident_service.config.arm import ArmConfig
from ident_service.config.control import Realtime
from ident_service.config.load import load_arm
from ident_service.motion.doctor import (
    Finding,
    State,
    Woken,
    bus_findings,
    judge_rates,
    kernel_findings,
    measure_wake_up,
    measuring_rate,
)
from ident_service.motion.realtime import IDLE_DRIVER, idle_cores_halt

GOOD = {
    "sys/kernel/realtime": "1\n",
    "proc/sys/kernel/sched_rt_runtime_us": "-1\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "performance\n",
    "sys/devices/system/cpu/online": "0-7\n",
    "sys/devices/system/cpu/isolated": "6-7\n",
    "proc/cpuinfo": "processor : 0\nflags : fpu tsc\n",
    "dev/cpu_dma_latency": "",
    "sys/devices/system/cpu/cpuidle/current_driver": "intel_idle\n",
}
# What an unprivileged process sees of this user's own limits is not in files.
OF_FILES = ("kernel", "real-time throttling", "processor frequency", "deep sleep of cores", "cores", "computer")


def looked(folder: Path, changes: dict[str, str | None] | None = None, **settings: Any) -> dict[str, Finding]:
    """Look at a kernel of files; None takes one away."""
    for name, text in (GOOD | (changes or {})).items():
        if text is not None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
    return {one.what: one for one in kernel_findings(Realtime(**settings), folder)}


def test_a_computer_that_is_set_up_has_nothing_to_mend(tmp_path: Path) -> None:
    found = looked(tmp_path)
    assert [found[what].state for what in OF_FILES] == [State.GOOD] * len(OF_FILES)
    assert [found[what].remedy for what in OF_FILES] == [""] * len(OF_FILES)


@pytest.mark.parametrize(
    ("what", "changes", "settings", "said", "remedy"),
    [
        ("kernel", {"sys/kernel/realtime": None}, {}, "no real-time kernel", "linux-image-rt"),
        ("real-time throttling", {"proc/sys/kernel/sched_rt_runtime_us": "500000"}, {}, "50% of 1 s", "sysctl"),
        (
            "processor frequency",
            {"sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "powersave\n"},
            {},
            "performance, powersave",
            "cpupower",
        ),
        ("cores", {"sys/devices/system/cpu/isolated": "\n"}, {}, "not isolated", "isolcpus"),
        ("cores", {}, {"cores": (2,)}, "not isolated", "isolcpus"),
        ("cores", {}, {"cores": (6, 9)}, "realtime.cores names 9", "online"),
        (
            "cores",
            {"sys/devices/system/cpu/isolated": "", "sys/devices/system/cpu/online": "0-1"},
            {},
            "2: no core can be isolated",
            "core",
        ),
        ("computer", {"proc/cpuinfo": "flags : fpu hypervisor tsc\n"}, {}, "virtual machine", "real computer"),
    ],
)
def test_what_is_poor_has_its_remedy(
    tmp_path: Path, what: str, changes: dict[str, str | None], settings: dict[str, Any], said: str, remedy: str
) -> None:
    found = looked(tmp_path, changes, **settings)
    assert found[what].state is State.POOR
    assert said in found[what].found
    assert remedy in found[what].remedy
    others = [one for one in OF_FILES if one != what]
    assert [found[one].state for one in others] == [State.GOOD] * len(others)


def test_where_the_kernel_has_no_say_in_sleep_the_core_is_kept_busy(tmp_path: Path) -> None:
    found = looked(tmp_path, {"sys/devices/system/cpu/cpuidle/current_driver": "none\n"})["deep sleep of cores"]
    assert found.state is State.GOOD
    assert "a motion keeps its core from halting" in found.found


def test_what_cannot_be_looked_at_is_unknown_and_no_error(tmp_path: Path) -> None:
    found = looked(tmp_path, dict.fromkeys(GOOD))
    unknown = {"real-time throttling", "processor frequency", "deep sleep of cores", "computer"}
    assert {what for what in OF_FILES if found[what].state is State.UNKNOWN} == unknown


def test_limits_of_a_user_without_privileges_are_reported_with_the_lines_that_mend_them() -> None:
    # Nobody may not read this checkout; modules that are loaded before are there.
    code = (
        "import os, resource\nfrom ident_service.motion.doctor import *\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (4096, 4096))\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "for one in kernel_findings(Realtime()): print(one.what, one.state.value, one.found, one.remedy, sep='|')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    told = {line.split("|")[0]: line.split("|")[1:] for line in done.stdout.splitlines()}
    state, found, remedy = told["real-time priority"]
    assert (state, found) == ("poor", "up to 0 for this user, 50 is described")
    assert "@realtime - rtprio 98" in remedy
    state, found, remedy = told["locked memory"]
    assert (state, found.split(";")[0]) == ("poor", "4 kB for this user")
    assert "memlock unlimited" in remedy
    if Path("/dev/cpu_dma_latency").exists() and os.getuid() == 0 and not idle_cores_halt(IDLE_DRIVER):
        assert told["deep sleep of cores"][0] == "poor"
        assert "udev" in told["deep sleep of cores"][2]


def test_an_interface_that_the_arm_names_is_looked_at(tmp_path: Path) -> None:
    shipped = load_arm("wam7_canopen")
    place = tmp_path / "sys/class/net/can0"
    place.mkdir(parents=True)

    def said(**files: str) -> str:
        for name, text in {"type": "280", "flags": "0x41", "tx_queue_len": "64", **files}.items():
            (place / name).write_text(f"{text}\n")
        (one,) = bus_findings(shipped, tmp_path)
        return f"{one.state.value}: {one.found} {one.remedy}"

    (absent,) = bus_findings(shipped, tmp_path / "nothing")
    assert absent.state is State.POOR
    assert "no such" in absent.found
    assert "docs/fieldbus.md" in absent.remedy or "modprobe" in absent.remedy
    assert said(type="1").startswith("poor: is no CAN interface")
    assert said(flags="0x40").startswith("poor: is down `ip link set can0 up")
    assert said(tx_queue_len="10").startswith("poor: its queue holds 10 frames")
    assert said() == "good: up, its queue holds 64 frames "
    driver = shipped.model_dump(mode="json", by_alias=True)
    driver["driver"]["buses"] = [{"interface": "ident_wire", "channel": "x"}]
    assert bus_findings(ArmConfig.model_validate(driver), tmp_path) == []
    assert bus_findings(load_arm("planar2"), tmp_path) == []


def woken(*stalls: tuple[float, float], seconds: float = 10.0, late: float = 5e-5, rate: float = 1000.0) -> Woken:
    """A loop that was woken `late`, but for stalls that begin and last so long [s]."""
    slots = np.arange(round(seconds * rate)) / rate
    lates = np.full(len(slots), late)
    for begin, length in stalls:
        inside = (slots >= begin) & (slots < begin + length)
        lates[inside] = np.maximum(lates[inside], begin + length - slots[inside])
    return Woken(1.0 / rate, lates, "", None, 0, 0.0)


def rates(
    seen: Woken, rate: float = 1000.0, described: float | None = None, **rest: Any
) -> dict[float, tuple[bool, int]]:
    return {round(one.rate): (one.good, one.stalls) for one in judge_rates(seen, rate, described, **rest)}


def test_a_computer_that_wakes_in_time_holds_every_rate() -> None:
    assert rates(woken()) == dict.fromkeys((1000, 500, 250, 200, 100), (True, 0))
    assert judge_rates(woken(rate=100.0), 0.4, None)[-1].good
    assert set(rates(woken(), 125.0)) == {1000, 500, 250, 200, 125, 100}


def test_a_stall_that_a_motion_survives_costs_no_rate_and_a_longer_one_all() -> None:
    assert rates(woken((3.0002, 0.009)))[1000] == (True, 0)
    assert rates(woken((3.0, 0.0125), (7.0, 0.0125)))[1000] == (False, 2)
    assert rates(woken((3.0, 0.0125)), described=0.015)[1000] == (True, 0)
    half = Watchdog("j1", "rpdo_timer", 0.016, "")
    assert rates(woken((3.0, 0.0095)), described=None, watchdogs=(half,))[1000] == (False, 1)


def test_a_rate_at_which_more_than_a_twentieth_of_a_second_is_late_is_not_held() -> None:
    often = woken(*((3.0 + 0.1 * k, 0.0072) for k in range(10)))
    found = judge_rates(often, 1000.0, None)
    assert [one.good for one in found if one.rate == 1000.0] == [False]
    assert found[0].stalls == 0
    assert found[0].late == pytest.approx(0.07, abs=0.005)
    # Late by 0.3 ms every time is too late for 1 kHz and nothing for 500 Hz.
    assert {rate: good for rate, (good, _) in rates(woken(late=3e-4)).items()} == {
        1000: False, 500: True, 250: True, 200: True, 100: True,
    }  # fmt: skip


@pytest.mark.slow
def test_what_is_measured_is_what_the_clock_did() -> None:
    class Stalling:
        lock_step, utc_offset_ns = False, 0

        def __init__(self) -> None:
            self.now, self.slept = 0, 0

        def now_ns(self) -> int:
            return self.now

        def sleep_until_ns(self, deadline_ns: int) -> None:
            self.slept += 1
            self.now = max(self.now, deadline_ns + (13_000_000 if self.slept == 500 else 20_000))

    seen = measure_wake_up(1000.0, 2.0, Realtime(), Stalling())
    assert seen.seconds == pytest.approx(2.0)
    assert seen.late.max() == pytest.approx(0.013)
    assert np.median(seen.late) == pytest.approx(20e-6)
    assert rates(seen)[1000] == (False, 1)
    assert not any(good for good, _ in rates(replace(seen, late=seen.late + 1.0)).values())
    stopped = measure_wake_up(1000.0, 2.0, Realtime(), Stalling(), iter([False, False, True]).__next__)
    assert len(stopped.late) == 2


@pytest.mark.parametrize(("rate", "measured"), [(1000.0, 1000.0), (500.0, 1000.0), (400.0, 1200.0), (2500.0, 2500.0)])
def test_rates_are_measured_at_a_whole_multiple(rate: float, measured: float) -> None:
    assert measuring_rate(rate) == measured


@pytest.mark.slow
def test_the_verb_says_whether_the_described_rate_can_be_held(tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    # No computer wakes a process within a nanosecond of when it asked for it.
    path.write_text(
        "extends: planar2\nname: hasty\ncontrol: {rate: 10000, longest_stall: 1.0e-9}\nrealtime: {priority: 1}\n"
    )
    done = [
        subprocess.run(
            [sys.executable, "-m", "ident_service", "doctor", *words, "--json"], capture_output=True, text=True
        )
        for words in ((str(path), "--seconds", "0.01"), ("--seconds", "0.5"))
    ]
    hasty, any_arm = (json.loads(one.stdout) for one in done)
    assert [one.returncode for one in done] == [3, 0]
    assert (hasty["arm"], hasty["rate"], hasty["can_hold"]) == ("hasty", 10000.0, False)
    assert any_arm["arm"] is None
    assert {"worst_late", "p999_late", "granted", "load"} <= set(any_arm["measured"])
    assert [one["rate"] for one in any_arm["rates"]] == [1000.0, 500.0, 250.0, 200.0, 100.0]
