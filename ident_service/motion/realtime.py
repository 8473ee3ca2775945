"""Ask the kernel for real time, so that a loop wakes in time: priority, memory, a core that stays awake.

Each is asked for by itself and none is needed: without privileges the loop works, wakes late now and then, and says so.
The answers go into the recording.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
import socket
import struct
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from ident_service.config.control import Realtime

LATENCY = Path("/dev/cpu_dma_latency")  # Documentation/power/pm_qos_interface.rst
IDLE_DRIVER = Path("/sys/devices/system/cpu/cpuidle/current_driver")  # Documentation/admin-guide/pm/cpuidle.rst
ISOLATED = Path("/sys/devices/system/cpu/isolated")
CAP_IPC_LOCK, CAP_SYS_NICE = 14, 23  # linux/capability.h
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h
# malloc.h, and glibc's own values, which `asked` puts back.
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
_TRIM_THRESHOLD, _MMAP_MAX = 128 * 1024, 65536
HEAP = 32 << 20  # bytes that the loop may take and give back without asking the kernel for a page
STACK = 512 << 10  # bytes, likewise
# Waits on a core, whenever nobody else wants it, for a lock that it has itself: gently to a core that shares its units
# with this one, as the C library pauses between two looks. Ends with its standard input.
_SPIN = """
import ctypes, os, threading
lock, libc = ctypes.c_int(), ctypes.CDLL(None)
libc.pthread_spin_init(ctypes.byref(lock), 0)
threading.Thread(target=lambda: (os.read(0, 1), os._exit(0))).start()
while True:
    libc.pthread_spin_lock(ctypes.byref(lock))
"""


@dataclass(frozen=True)
class RealtimePrivileges:
    """Represent the real-time privileges that were granted, and why the others were refused.

    Attributes:
        scheduling: whether the process has SCHED_FIFO.
        memory: whether present and future memory is locked.
        core: the core that is this process's own, or None.
        collector: whether the garbage collector is frozen and switched off.
        refusals: one sentence each.
        awake: whether cores stay out of deep sleep.
        prefaulted: whether heap and stack have their pages, and keep them.
        spinning: whether its own core is kept from halting where only whoever runs this virtual machine could.
        held: exit stack with the kernel's promises, which end when it is closed or forgotten.
    """

    scheduling: bool
    memory: bool
    core: int | None
    collector: bool
    refusals: tuple[str, ...]
    awake: bool = False
    prefaulted: bool = False
    spinning: bool = False
    held: ExitStack = field(default_factory=ExitStack, repr=False, compare=False)

    def sentence(self) -> str:
        """Describe the grants and refusals in one sentence, for people and for the recording."""
        got = [
            name
            for name, one in (
                ("SCHED_FIFO", self.scheduling),
                ("locked memory", self.memory),
                ("heap and stack in place", self.prefaulted),
                (f"core {self.core}", self.core is not None),
                ("cores kept awake", self.awake),
                ("a core that never halts", self.spinning),
                ("no garbage collection", self.collector),
            )
            if one
        ]
        return f"real time: got {', '.join(got) or 'nothing'}" + "".join(f"; {reason}" for reason in self.refusals)


def request_privileges(core_counted_from_last: int = 0, settings: Realtime | None = None) -> RealtimePrivileges:
    """Request real-time priority, locked memory and a core, stop garbage collection; return what was granted.

    Args:
        core_counted_from_last: number of the core, counted back from the last; for a second loop beside the first.
        settings: real-time settings of the arm's description, whose cores take precedence; defaults when None.

    Returns:
        What was got. It must be kept for as long as the loop runs: the core and the awake cores are lost with it.
    """
    settings = Realtime() if settings is None else settings
    refusals: list[str] = []
    held = ExitStack()
    scheduling = False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(settings.priority))
        scheduling = True
    except OSError as error:
        refusals.append(f"SCHED_FIFO refused ({error.strerror})")
    # Memory that is taken before it is locked is locked with the rest.
    prefaulted = _prefault(refusals)
    memory = _lock_memory(refusals)
    core = _own_core(_candidates(settings, core_counted_from_last), bool(settings.cores), held, refusals)
    awake = _keep_awake(held, refusals)
    spinning = core is not None and _keep_from_halting(core, held, refusals)
    gc.collect()
    gc.freeze()
    gc.disable()
    return RealtimePrivileges(scheduling, memory, core, True, tuple(refusals), awake, prefaulted, spinning, held)


@contextmanager
def temporary_privileges(
    core_counted_from_last: int = 0, settings: Realtime | None = None
) -> Iterator[RealtimePrivileges]:
    """Request the privileges of `request_privileges`, yield what was granted, and give them back after the block.

    Args:
        core_counted_from_last: as for `request_privileges`.
        settings: as for `request_privileges`.
    """
    policy, cores, collecting = os.sched_getscheduler(0), os.sched_getaffinity(0), gc.isenabled()
    parameter = os.sched_getparam(0)
    granted: RealtimePrivileges | None = None
    try:
        granted = request_privileges(core_counted_from_last, settings)
        yield granted
    finally:
        if granted is not None:
            granted.held.close()
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameter)
        with suppress(OSError):
            os.sched_setaffinity(0, cores)
        libc = ctypes.CDLL(None)
        libc.munlockall()
        if hasattr(libc, "mallopt"):
            libc.mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD)
            libc.mallopt(_M_MMAP_MAX, _MMAP_MAX)
            libc.malloc_trim(0)
        gc.unfreeze()
        if collecting:
            gc.enable()


def capable(capability: int) -> bool:
    """Return whether this process has a capability in effect, by its number in linux/capability.h."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("CapEff:"):
                return bool(int(line.split()[1], 16) >> capability & 1)
    return False


def core_numbers(text: str) -> list[int]:
    """Return the numbers in the kernel's list of cores, as in "1,4-6"."""
    found: list[int] = []
    for part in text.strip().split(","):
        if part:
            first, _, last = part.partition("-")
            found += range(int(first), int(last or first) + 1)
    return found


def _prefault(refusals: list[str]) -> bool:
    """Have heap and stack touched once, and what is freed kept: a page that the kernel must find makes a cycle late."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        refusals.append("this C library does not keep freed memory")
        return False
    # No trimming, and large blocks from the heap as well, whose pages stay; mmap's would go with each block.
    kept = libc.mallopt(_M_TRIM_THRESHOLD, -1) == 1 and libc.mallopt(_M_MMAP_MAX, 0) == 1
    libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = (
        ctypes.c_void_p,
        [ctypes.c_size_t],
        [ctypes.c_void_p],
    )
    block = libc.malloc(HEAP)
    if not kept or not block:
        refusals.append(f"no {HEAP >> 20} MiB of heap in advance")
        return False
    ctypes.memset(block, 1, HEAP)
    libc.free(block)
    # An argument by value is copied onto the stack; a function that takes none leaves it alone.
    depth = type("_Depth", (ctypes.Structure,), {"_fields_": [("bytes", ctypes.c_char * STACK)]})
    touch = ctypes.CDLL(None).getppid
    touch.argtypes = [depth]
    touch(depth())
    return True


def _lock_memory(refusals: list[str]) -> bool:
    libc = ctypes.CDLL(None, use_errno=True)
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY or capable(CAP_IPC_LOCK)
    # Under a limit, what a loop asks for later would be refused instead of being slow.
    if libc.mlockall(_MCL_CURRENT | (_MCL_FUTURE if unlimited else 0)) != 0:
        refusals.append(f"locked memory refused ({os.strerror(ctypes.get_errno())})")
        return False
    if not unlimited:
        refusals.append("memory that is taken later is not locked (memlock is limited)")
    return True


def _candidates(settings: Realtime, core_from_last: int) -> list[int]:
    """Cores in the order in which they are wanted."""
    if settings.cores:
        return list(settings.cores)
    isolated: list[int] = []
    with suppress(OSError, ValueError):
        isolated = core_numbers(ISOLATED.read_text(encoding="utf-8"))
    # The last ones: interrupts and whoever started us prefer the first.
    others = sorted(os.sched_getaffinity(0) - set(isolated))
    cores = [*reversed(isolated), *reversed(others)]
    first = core_from_last % len(cores)
    return cores[first:] + cores[:first] if len(cores) > 1 else []


def _own_core(cores: list[int], described: bool, held: ExitStack, refusals: list[str]) -> int | None:
    """Take the first core that no other loop has, named by an abstract address as buses are (decision 0048)."""
    taken: list[int] = []
    for core in cores:
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            lock.bind(f"\0ident-core-{core}".encode())
        except OSError:
            lock.close()
            taken.append(core)
            continue
        try:
            os.sched_setaffinity(0, {core})
        except OSError as error:
            lock.close()
            if described or core == cores[-1]:
                refusals.append(f"core {core} refused ({error.strerror})")
            continue
        held.callback(lock.close)
        return core
    if taken:
        # Two loops on one core would wait for each other; the kernel finds each a place.
        which = ", ".join(map(str, taken))
        refusals.append(f"no core of its own: other loops have {'core' if len(taken) == 1 else 'cores'} {which}")
    elif not cores:
        refusals.append("one core only")
    return None


def idle_cores_halt(idle_driver_file: Path) -> bool:
    """Return whether the file says that the idle driver is `none`: then idle cores halt in spite of `LATENCY`.

    Args:
        idle_driver_file: the file that names it, `IDLE_DRIVER`.
    """
    with suppress(OSError):
        return idle_driver_file.read_text(encoding="utf-8").strip() == "none"
    return False


def _keep_from_halting(core: int, held: ExitStack, refusals: list[str]) -> bool:
    """Keep a core busy at the lowest priority, where a halted one is given back late by whoever runs the machine."""
    if not idle_cores_halt(IDLE_DRIVER):
        return False
    ends, lives = os.pipe()
    silent = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_WRONLY, 0) for number in (1, 2)]
    try:
        pid = os.posix_spawn(
            sys.executable,
            [sys.executable, "-I", "-S", "-c", _SPIN],
            {},
            file_actions=[(os.POSIX_SPAWN_DUP2, ends, 0), *silent],
            scheduler=(os.SCHED_OTHER, os.sched_param(0)),  # not the loop's own
        )
    except OSError as error:
        os.close(lives)
        refusals.append(f"nothing keeps core {core} from halting ({error.strerror})")
        return False
    finally:
        os.close(ends)
    spinner = ExitStack()
    spinner.callback(_end, pid)
    spinner.callback(os.close, lives)
    try:
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
        os.sched_setaffinity(pid, {core})
    except OSError as error:  # at any other priority, or on another core, it would be in somebody's way
        spinner.close()
        refusals.append(f"nothing keeps core {core} from halting ({error.strerror})")
        return False
    held.push(spinner)
    return True


def _end(pid: int) -> None:
    """End a child, which may have ended, or have been waited for, already."""
    with suppress(OSError):
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def _keep_awake(held: ExitStack, refusals: list[str]) -> bool:
    """Ask for a wake-up latency of 0 us, which holds while the file is open."""
    try:
        file = os.open(LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        refusals.append(f"{LATENCY} refused ({error.strerror})")
        return False
    held.callback(os.close, file)
    try:
        os.write(file, struct.pack("=i", 0))
    except OSError as error:
        refusals.append(f"{LATENCY} refused ({error.strerror})")
        return False
    return True
