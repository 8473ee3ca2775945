"""Run a command in a virtual machine that has this machine's files and Debian's stock kernel, and say how it ended.

The guest is emulated (QEMU's TCG), so that it needs no KVM; it has no network. It sees the host's files read-only, with
what it changes kept in its memory, so that the same Python environment runs inside. Kernel and busybox come from the
Debian archive into `build/socketcan`, once.

Usage: guest.py COMMAND [ARGUMENT...], with the environment's PATH and the present folder.
"""

from __future__ import annotations

import gzip
import lzma
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
BUILD = HERE.parents[2] / "build" / "socketcan"
LONGEST = 1800  # s that a guest may live, on a machine that has more to do
KEPT = ("PATH", "PYTHONPATH", "OPENBLAS_NUM_THREADS", "LANG", "CI")
TOOLS = {  # with the package that has them
    "qemu-system-x86_64": "qemu-system-x86",
    "apt-get": "apt",
    "dpkg": "dpkg",
    "setpriv": "util-linux",
    "unshare": "util-linux",
    "ip": "iproute2",
    "tc": "iproute2",
}
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "can-raw", "vcan")  # and whatever they depend on
MACHINE = (
    *("qemu-system-x86_64", "-accel", "tcg", "-cpu", "max", "-m", "2048"),
    # The guest's time is its instructions, at 2 ns each, and goes on to the next timer at once where nobody computes: a
    # busy host makes nobody late. Only what waits for a file of the host, while nothing else is due, finds it late.
    *("-icount", "shift=1,sleep=off"),
    *("-nic", "none", "-display", "none", "-monitor", "none", "-no-reboot"),
    # Two serial lines: what is said, and the exit code.
    *("-serial", "stdio"),
    # Without the remapping of inodes a file of one file system is taken for another's.
    *("-fsdev", "local,id=host,path=/,security_model=none,readonly=on,multidevs=remap"),
    *("-device", "virtio-9p-pci,fsdev=host,mount_tag=host"),
    *("-append", "console=ttyS0 quiet panic=-1"),
)


def main(command: list[str]) -> int:
    """Run it; returns its exit code."""
    for tool, package in TOOLS.items():
        if shutil.which(tool) is None:
            sys.exit(f"{tool} is missing; as root: `apt-get install {package}`")
    root = unpacked()
    kernel, initial, code = next((root / "boot").glob("vmlinuz-*")), BUILD / "initial.cpio.gz", BUILD / "exit_code"
    initial.write_bytes(gzip.compress(b"".join(archive(initial_files(root, command))), 1))
    code.unlink(missing_ok=True)
    # However this process ends, the guest ends with it.
    machine = ["setpriv", "--pdeathsig", "KILL", *MACHINE, "-serial", f"file:{code}"]
    try:
        subprocess.run([*machine, "-kernel", kernel, "-initrd", initial], stdin=subprocess.DEVNULL, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        sys.exit(f"the guest was switched off after {LONGEST} s")
    except KeyboardInterrupt:
        return 130
    told = code.read_text().strip() if code.exists() else ""
    if not told:
        sys.exit("the guest ended without a word about the command; what it said is above")
    return int(told)


def unpacked() -> Path:
    """Debian's kernel with its modules, and busybox; fetched from the archive where they are not there yet."""
    root = BUILD / "root"
    if not (root / "complete").exists():
        shutil.rmtree(BUILD, ignore_errors=True)
        root.mkdir(parents=True)
        found = output("apt-cache", "depends", "linux-image-amd64")
        kernel = next((w for w in found.split() if w.startswith("linux-image-") and w != "linux-image-amd64"), None)
        if kernel is None:
            sys.exit("apt knows no linux-image-amd64; as root: `apt-get update` (on Debian for amd64)")
        output("apt-get", "download", kernel, "busybox-static")
        for package in BUILD.glob("*.deb"):
            output("dpkg", "-x", str(package), str(root))
            package.unlink()
        (root / "complete").touch()
    return root


def output(*command: str) -> str:
    """What a command says; its failure is ours."""
    done = subprocess.run(command, cwd=BUILD, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"`{shlex.join(command)}` failed; as root: `apt-get update`\n{done.stderr}")
    return done.stdout


def initial_files(root: Path, command: list[str]) -> Iterator[tuple[str, bytes]]:
    """Name and content of what the guest begins with."""
    yield "bin/busybox", next(root.glob("**/bin/busybox")).read_bytes()
    yield "init", (HERE / "init").read_bytes()
    files = {file.name.split(".")[0].replace("-", "_"): file for file in root.glob("**/lib/modules/*/kernel/**/*.ko*")}
    modules = dict(pair for name in MODULES for pair in needed(name.replace("-", "_"), files))
    yield "modules/order", "".join(f"{name}\n" for name in modules).encode()
    for name, content in modules.items():
        yield f"modules/{name}.ko", content
    kept = "".join(f"export {name}={shlex.quote(os.environ[name])}\n" for name in KEPT if name in os.environ)
    place = f"export HOME=/run TMPDIR=/run\ncd {shlex.quote(str(Path.cwd()))}\n"
    yield "command", f"{kept}{place}{shlex.join(command)}\n".encode()


def needed(module: str, files: dict[str, Path]) -> Iterator[tuple[str, bytes]]:
    """A module, by name and content, after those that it depends on, as its section .modinfo says."""
    content = files[module].read_bytes()
    if files[module].suffix == ".xz":  # since Debian 13
        content = lzma.decompress(content)
    found = re.search(rb"\0depends=([^\0]*)", content)
    for other in filter(None, found[1].decode().split(",") if found else ()):
        yield from needed(other.replace("-", "_"), files)
    yield module, content


def archive(files: Iterator[tuple[str, bytes]]) -> Iterator[bytes]:
    """The files, with the folders that they need, as the kernel reads them (cpio newc; Documentation: initramfs)."""
    folders: set[str] = set()
    for name, content in files:
        for folder in reversed(Path(name).parents[:-1]):
            if str(folder) not in folders:
                folders.add(str(folder))
                yield entry(str(folder), stat.S_IFDIR | 0o755, b"")
        yield entry(name, stat.S_IFREG | 0o755, content)
    yield entry("TRAILER!!!", 0, b"")


def entry(name: str, mode: int, content: bytes) -> bytes:
    """One of its entries, padded to four bytes."""
    fields = (0, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % field for field in fields) + name.encode() + b"\0"
    return head + bytes(-len(head) % 4) + content + bytes(-len(content) % 4)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
