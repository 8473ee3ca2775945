"""Tell what of this computer a motion depends on: its kernel, what this user may ask of it, and how late loops wake.

What is looked at needs no privileges; what cannot be looked at is said. Lateness is measured as cyclictest does, in a
process that sets itself up as the motion process does (`realtime.py`), and judged by the numbers that judge a motion
(`cycle_timing.py`): a rate is held where no motion would have ended.
"""

from __future__ import annotations

import math
import os
import resource
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from drivers.arm import Vector, Watchdog
from drivers.can.bus_state import BusError
from drivers.can.socketcan_link import check_interface
from drivers.clock import Clock, RealClock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
from ident_service.config.control import Realtime
from ident_service.motion.cycle_timing import LATE, SUCCESS, longest_stall
from ident_service.motion.realtime import (
    CAP_IPC_LOCK,
    CAP_SYS_NICE,
    IDLE_DRIVER,
    capable,
    core_numbers,
    idle_cores_halt,
    temporary_privileges,
)

LEAST_RATE = 1000.0  # Hz, at which lateness is measured at least
_SHARES = (1, 2, 4, 5, 10)  # of that rate, that are judged
_QUEUE = 64  # frames, of docs/fieldbus.md
_RUNTIME = 0.95  # share of a second that the kernel leaves to real-time processes; loops here take less
_CAN = 280  # ARPHRD_CAN, linux/if_arp.h
_LIMITS = "/etc/security/limits.d/ident.conf"


class State(Enum):
    """State of one property of this computer."""

    GOOD = "good"
    POOR = "poor"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: subject of the finding.
        state: judgement of it.
        found: what was found, in words.
        remedy: what to do; empty where nothing is to be done.
    """

    what: str
    state: State
    found: str
    remedy: str = ""


@dataclass(frozen=True)
class Woken:
    """Lateness of a loop that only sleeps.

    Attributes:
        period: period of the loop's slots [s].
        late: lateness of the loop in each slot [s], shape (slots,).
        sentence: description of what the kernel granted.
        stolen: share of all processors' time in which the host of this virtual machine let others run; None where
            the kernel does not tell.
        faults: number of pages that the kernel had to find while the loop ran.
        load: mean number of processes that wanted a processor in the last minute.
    """

    period: float
    late: Vector
    sentence: str
    stolen: float | None
    faults: int
    load: float

    @property
    def seconds(self) -> float:
        """Return the duration of the measurement [s]: the number of slots times their period."""
        return len(self.late) * self.period

    def lateness_quantile(self, share: float) -> float:
        """Return the lateness that `share` of the slots do not exceed [s]."""
        return float(np.quantile(self.late, share))


@dataclass(frozen=True)
class Held:
    """A rate, and whether a motion at it would have gone on all the time.

    Attributes:
        rate: [Hz].
        longest_stall: longest stall that such a motion survives [s].
        stalls: number of longer stalls.
        late: share of the cycles that were late or lost in the worst second.
        good: whether no motion would have ended.
    """

    rate: float
    longest_stall: float
    stalls: int
    late: float
    good: bool


def kernel_findings(settings: Realtime, root: Path = Path("/")) -> list[Finding]:
    """Return the findings on this kernel's real-time features and this user's privileges, one for each check.

    Args:
        settings: of the arm's description.
        root: folder that `proc`, `sys` and `dev` are in.
    """
    return [
        _preemption(root),
        _throttling(root),
        _governor(root),
        _priority(settings),
        _memory(),
        _wake_up(root),
        _cores(settings, root),
        _machine(root),
    ]


def bus_findings(config: ArmConfig, root: Path = Path("/")) -> list[Finding]:
    """Return one finding for each CAN interface of the kernel that an arm names; empty where it names none."""
    return [_interface(bus, root) for bus in config.can_buses if bus.medium == "kernel"]


def measure_wake_up(
    rate: float,
    seconds: float,
    settings: Realtime,
    clock: Clock | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Woken:
    """Sleep from slot to slot at `rate` under real-time privileges, and return how late each slot was reached.

    Args:
        rate: rate of the slots [Hz].
        seconds: duration of the measurement [s].
        settings: of the arm's description.
        clock: the machine's when None.
        stop_requested: called in each slot; True ends the measurement, and what was measured until then counts.
    """
    clock = RealClock() if clock is None else clock
    period_ns = round(1e9 / rate)
    late_ns = np.full(max(1, round(seconds * rate)), -1, dtype=np.int64)
    with temporary_privileges(settings=settings) as granted:
        before, faults = _processor_time(), resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        deadline_ns, count = clock.now_ns() + 10 * period_ns, 0
        while count < len(late_ns) and not stop_requested():
            clock.sleep_until_ns(deadline_ns)
            late_ns[count] = clock.now_ns() - deadline_ns
            count, deadline_ns = count + 1, deadline_ns + period_ns
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
        after = _processor_time()
    stolen = None
    if before is not None and after is not None and after[1] > before[1]:
        stolen = (after[0] - before[0]) / (after[1] - before[1])
    late = late_ns[: max(count, 1)].clip(min=0) * 1e-9
    return Woken(1.0 / rate, late, granted.sentence(), stolen, faults, os.getloadavg()[0])


def measuring_rate(rate: float) -> float:
    """Return the lowest whole multiple of `rate` [Hz] that is at least `LEAST_RATE`."""
    return rate * max(1, math.ceil(LEAST_RATE / rate))


def judge_rates(
    woken: Woken, rate: float, configured_stall: float | None, watchdogs: tuple[Watchdog, ...] = ()
) -> list[Held]:
    """Judge `rate`, the measured rate and parts of it, highest first: good if no stall is too long and few are late.

    Args:
        woken: lateness that was measured.
        rate: rate that is judged in any case [Hz]; the measured one is a multiple of it.
        configured_stall: `control.longest_stall` of the arm's description [s].
        watchdogs: of its drives.
    """
    every = {*_SHARES, round(1.0 / (woken.period * rate))}
    return [_held(woken, n, configured_stall, watchdogs) for n in sorted(every)]


def _held(woken: Woken, every: int, described: float | None, watchdogs: tuple[Watchdog, ...]) -> Held:
    period = every * woken.period
    late = woken.late[::every]
    survived = longest_stall(described, period, watchdogs)
    # A stall makes all slots late that fall into it.
    too_long = late > survived
    stalls = int(too_long[0]) + int((too_long[1:] & ~too_long[:-1]).sum())
    # A slot that is reached later than this is left to the next one.
    lost = np.concatenate([[0], np.cumsum(late > LATE * period)])
    second = min(max(round(1.0 / period), 1), len(late))
    most = int((lost[second:] - lost[:-second]).max())
    return Held(1.0 / period, survived, stalls, most * period, stalls == 0 and most <= (1.0 - SUCCESS) / period)


def _preemption(root: Path) -> Finding:
    what = "kernel"
    release = os.uname().release
    if _text(root / "sys/kernel/realtime") == "1":
        return Finding(what, State.GOOD, f"{release}, PREEMPT_RT")
    return Finding(
        what,
        State.POOR,
        f"{release} is no real-time kernel (PREEMPT_RT)",
        "install one (Debian: `linux-image-rt-amd64`, Ubuntu: `pro enable realtime-kernel`); without it rates of some "
        "hundred hertz may do",
    )


def _throttling(root: Path) -> Finding:
    what = "real-time throttling"
    try:
        runtime = int(_text(root / "proc/sys/kernel/sched_rt_runtime_us") or "")
        period = int(_text(root / "proc/sys/kernel/sched_rt_period_us") or "")
    except ValueError:
        return Finding(what, State.UNKNOWN, "sched_rt_runtime_us cannot be read")
    if runtime < 0:
        return Finding(what, State.GOOD, "off")
    share = runtime / period
    found = f"real-time processes get {share:.0%} of {period / 1e6:g} s"
    if share >= _RUNTIME:
        return Finding(what, State.GOOD, f"{found}, more than a loop takes")
    return Finding(what, State.POOR, found, "`sysctl kernel.sched_rt_runtime_us=-1`, or 0.95 of the period")


def _governor(root: Path) -> Finding:
    what = "processor frequency"
    files = sorted((root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor"))
    found = sorted({_text(file) or "unreadable" for file in files})
    if not found:
        return Finding(what, State.UNKNOWN, "no cpufreq: a virtual machine, or the firmware chooses")
    if found == ["performance"]:
        return Finding(what, State.GOOD, "governor performance on every core")
    remedy = "`cpupower frequency-set -g performance`, at every boot"
    return Finding(what, State.POOR, f"governor {', '.join(found)}: cores that idle become slow", remedy)


def _priority(settings: Realtime) -> Finding:
    what, wanted = "real-time priority", settings.priority
    allowed = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if capable(CAP_SYS_NICE):
        return Finding(what, State.GOOD, f"any, {wanted} is described (CAP_SYS_NICE)")
    if allowed == resource.RLIM_INFINITY or allowed >= wanted:
        return Finding(what, State.GOOD, f"up to {'any' if allowed < 0 else allowed}, {wanted} is described")
    remedy = f"`@realtime - rtprio {max(wanted, 98)}` in {_LIMITS}, and log in anew as a member of that group"
    return Finding(what, State.POOR, f"up to {allowed} for this user, {wanted} is described", remedy)


def _memory() -> Finding:
    what = "locked memory"
    allowed = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if allowed == resource.RLIM_INFINITY or capable(CAP_IPC_LOCK):
        return Finding(what, State.GOOD, "unlimited")
    remedy = f"`@realtime - memlock unlimited` in {_LIMITS}, and log in anew as a member of that group"
    return Finding(
        what, State.POOR, f"{allowed >> 10} kB for this user; a motion process needs some hundred MB", remedy
    )


def _wake_up(root: Path) -> Finding:
    what, file = "deep sleep of cores", root / "dev/cpu_dma_latency"
    if idle_cores_halt(root / IDLE_DRIVER.relative_to("/")):
        return Finding(what, State.GOOD, "not this kernel's (virtual machine); a motion keeps its core from halting")
    if not file.exists():
        return Finding(what, State.UNKNOWN, "no /dev/cpu_dma_latency in this container, or kernel")
    if os.access(file, os.W_OK):
        return Finding(what, State.GOOD, "prevented while a motion runs (/dev/cpu_dma_latency)")
    rule = 'KERNEL=="cpu_dma_latency", GROUP="realtime", MODE="0660"'
    remedy = f"`{rule}` in /etc/udev/rules.d/70-cpu-dma-latency.rules, then `udevadm trigger`"
    return Finding(what, State.POOR, "/dev/cpu_dma_latency is not writable for this user", remedy)


def _cores(settings: Realtime, root: Path) -> Finding:
    what = "cores"
    try:
        here = core_numbers(_text(root / "sys/devices/system/cpu/online") or "")
        isolated = core_numbers(_text(root / "sys/devices/system/cpu/isolated") or "")
    except ValueError:
        return Finding(what, State.UNKNOWN, "the kernel's lists of cores cannot be read")
    if absent := sorted(set(settings.cores) - set(here)):
        return Finding(
            what,
            State.POOR,
            f"realtime.cores names {', '.join(map(str, absent))}, this computer has {len(here)}",
            "name cores that are online",
        )
    wanted = settings.cores or tuple(isolated)
    if wanted and set(wanted) <= set(isolated):
        return Finding(what, State.GOOD, f"{', '.join(map(str, wanted))} isolated")
    remedy = "`isolcpus=3 nohz_full=3 rcu_nocbs=3` on the kernel's command line isolates core 3"
    if len(here) < 3:
        return Finding(what, State.POOR, f"{len(here)}: no core can be isolated", "more cores")
    return Finding(what, State.POOR, f"of {len(here)}, the motion's is not isolated", remedy)


def _machine(root: Path) -> Finding:
    what = "computer"
    text = _text(root / "proc/cpuinfo")
    if text is None:
        return Finding(what, State.UNKNOWN, "/proc/cpuinfo cannot be read")
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "")
    if " hypervisor" in flags:
        return Finding(
            what,
            State.POOR,
            "a virtual machine, which its host may stall at any time",
            "run motions on a real computer",
        )
    return Finding(what, State.GOOD, "no virtual machine")


def _interface(bus: CanBus, root: Path) -> Finding:
    what = f"CAN interface {bus.channel}"
    try:
        check_interface(bus)
    except BusError as error:
        return Finding(what, State.POOR, str(error), 'docs/fieldbus.md, "Wiring and naming interfaces"')
    place = root / "sys/class/net" / bus.channel
    up = f"`ip link set {bus.channel} up type can bitrate {bus.bitrate}`"
    if not place.is_dir():
        return Finding(what, State.POOR, "this kernel has no such interface", f"`modprobe can-raw`, then {up}")
    kind, flags, queue = (_text(place / name) for name in ("type", "flags", "tx_queue_len"))
    if kind != str(_CAN):
        return Finding(what, State.POOR, "is no CAN interface", "name another one in driver.buses")
    if flags is not None and not int(flags, 16) & 1:
        return Finding(what, State.POOR, "is down", up)
    if queue is not None and int(queue) < _QUEUE:
        remedy = f"`ip link set {bus.channel} txqueuelen {_QUEUE}`"
        return Finding(what, State.POOR, f"its queue holds {queue} frames, a bring-up needs {_QUEUE}", remedy)
    return Finding(what, State.GOOD, "up" if queue is None else f"up, its queue holds {queue} frames")


def _text(path: Path) -> str | None:
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8").strip()
    return None


def _processor_time() -> tuple[int, int] | None:
    """Return stolen and all time of all processors since boot (proc_stat(5)), None where the kernel does not tell."""
    fields = (_text(Path("/proc/stat")) or "").partition("\n")[0].split()[1:]
    if len(fields) < 8:
        return None
    times = [int(one) for one in fields[:8]]
    return times[7], sum(times)
