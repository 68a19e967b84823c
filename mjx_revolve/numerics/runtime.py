"""The process of a run: thread settings, JAX's compilation cache, and its description.

`prepare_process` comes first in a command's `main`, before NumPy and JAX are loaded; nothing here
imports them at the top.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import importlib.metadata
import importlib.util
import logging
import os
import platform
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not on Windows: there, each process compiles
    fcntl = None  # type: ignore[assignment]

# CMA-ES's eigendecomposition gives other bits with other numbers of BLAS threads.
_THREAD_SETTINGS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# LLVM unrolls loops of up to some twenty passes before it looks for vectors, and then finds none.
# Robots that touch themselves are computed by fours: with loops kept, 256 random bodies step a
# fifth faster, and programs compile in a tenth less time. Some programs have other last bits.
_LLVM = "--xla_backend_extra_options=-unroll-full-max-count=1"
# Settings of JAX that change bits, by the variables that set them, and what they usually are.
_MODES = {
    "JAX_ENABLE_X64": False,
    "JAX_DEFAULT_MATMUL_PRECISION": None,
    "JAX_DEFAULT_PRNG_IMPL": "threefry2x32",
    "JAX_THREEFRY_PARTITIONABLE": True,
}
_PACKAGES = (
    "mjx_revolve", "jax", "jaxlib", "mujoco", "mujoco-mjx", "evosax", "numpy", "scipy",
)  # fmt: skip
# When Python looks for garbage: thresholds of `gc`, usually, and while a process starts (a choice).
_COLLECTIONS, _SELDOM = gc.get_threshold(), 50_000
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# A worker caches only programs that took longer to compile than this [s]. The main process caches
# all: at a start it runs a hundred small programs, 2 s to compile and .3 s to read back.
_WORKER_MIN_COMPILE_TIME = 0.5
# Individuals stepped together on a CPU: enough to fill vector registers, few enough that the loop's
# live values stay in the first-level cache (measured: 64 to 256 alike, 16 to 32 slower). It stands
# here because workers are counted before JAX is imported.
LANES = 64
_PACKAGE = Path(__file__).resolve().parents[1]
_log = logging.getLogger(__name__)
# Cores that XLA's threads are made for, where those are not all.
_xla_cores: int | None = None
_programs: Path | None = None


def _fix_threads() -> None:
    for name in _THREAD_SETTINGS:
        os.environ.setdefault(name, "1")


def fix_environment() -> None:
    """Fixes what NumPy reads when it is imported, and XLA when it starts: threads, LLVM's options.

    Options that a user gives LLVM take the place of ours.
    """
    _fix_threads()
    flags = os.environ.get("XLA_FLAGS", "")
    if flags.strip()[:1] not in ("", "-"):  # to XLA, the path of a file with flags
        return
    if expects_cpu() and "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_LLVM}".strip()


def user_flags(flags: str) -> str:
    """Flags of XLA without that of `fix_environment`."""
    return flags.replace(_LLVM, "").strip()


@contextlib.contextmanager
def few_collections() -> Iterator[None]:
    """Looks for garbage seldom: what imports and traces make stays, and looking takes a sixth."""
    gc.set_threshold(_SELDOM, *_COLLECTIONS[1:])
    try:
        yield
    finally:
        gc.set_threshold(*_COLLECTIONS)


def prepare_process() -> Path | None:
    """Fixes the environment and turns on JAX's persistent compilation cache.

    Settings that are already there (`OPENBLAS_NUM_THREADS`, `XLA_FLAGS`,
    `JAX_COMPILATION_CACHE_DIR`) are respected, and so is a cache folder that JAX already has;
    an empty `JAX_COMPILATION_CACHE_DIR` turns the cache off. Imports JAX.

    Returns:
        The cache folder in use, or None.
    """
    folder = find_cache()
    _use_cache(folder, 0.0)
    return folder


def find_cache() -> Path | None:
    """Fixes the environment and finds the cache folder of `prepare_process`, without JAX."""
    fix_environment()
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if "jax" in sys.modules and (known := sys.modules["jax"].config.jax_compilation_cache_dir):
        chosen = known
    if chosen and "://" in chosen:
        _log.warning("no compilation cache: expected a folder; found %s", chosen)
        chosen = ""
    folder = cache_folder() if chosen is None else (Path(chosen).absolute() if chosen else None)
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            remove_broken_entries(folder)
        except OSError as error:  # a read-only home: slower starts, the same results
            _log.warning("no compilation cache: %s: %s", error.strerror, folder)
            folder = None
    return folder


def expects_cpu() -> bool:
    """Whether JAX will find nothing but CPUs (as the environment says before its import)."""
    if os.environ.get("JAX_PLATFORMS", "cpu") not in ("", "cpu"):
        return False
    return all(importlib.util.find_spec(name) is None for name in ("jax_plugins", "libtpu"))


def _use_cache(folder: Path | None, min_compile_time: float) -> None:
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder) if folder else None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", min_compile_time)
    global _programs
    _programs = folder / "programs" if folder else None
    source_hash()  # of the source that is imported, whatever becomes of the files


def program_folder() -> Path | None:
    """The folder of whole programs (see `executables`); None outside of commands: none are kept."""
    return _programs


def prepare_worker(core: int | None, cache: str | None) -> None:
    """Prepares a worker process as `prepare_process` does a command; imports JAX.

    Args:
        core: the only core that the worker will use after `pin_process`; None: any. XLA starts one
            thread for each usable core, so such a worker runs blocks in a single thread. Compiling
            takes more threads, on cores that are still idle.
        cache: the compilation cache's folder that the main process uses. The main process has
            removed broken entries; the worker does not, as an entry may be in writing.
    """
    _fix_threads()  # XLA's flags are those of the process that the worker works for
    os.environ["JAX_PLATFORMS"] = "cpu"
    _use_cache(Path(cache) if cache else None, _WORKER_MIN_COMPILE_TIME)
    if core is not None:
        import jax

        global _xla_cores
        _xla_cores = 1
        cores = list_cores()
        pin_process([core])
        jax.devices()
        pin_process(cores)


@contextlib.contextmanager
def compile_lock(kind: str, fingerprint: str) -> Iterator[None]:
    """A lock between the processes of a host: one compiles, the others wait for its result.

    The others then read the compiled program from the compilation cache; compiling it at the same
    time would take all of them longer. Without a cache there is no lock.

    Args:
        kind: `job`, or `program` within a job's lock; two kinds, so that there is no deadlock.
        fingerprint: of the program.
    """
    import jax

    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not folder or fcntl is None:
        yield
        return
    # Few names, so that they do not pile up; two programs of one name wait for each other.
    with contextlib.ExitStack() as opened:
        with contextlib.suppress(OSError):  # a folder that is read only, or without locks
            name = f".compiling-{kind}-{fingerprint[:2]}"
            lock = opened.enter_context(open(Path(folder) / name, "ab"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fcntl.flock(lock, fcntl.LOCK_SH)
        yield


def pin_process(cores: Sequence[int]) -> None:
    """Pins all threads of this process to these cores, by number, if the system supports it."""
    if not hasattr(os, "sched_setaffinity"):
        return
    folder = Path("/proc/self/task")
    threads = [int(thread.name) for thread in folder.iterdir()] if folder.is_dir() else [0]
    for thread in threads:
        # The thread has ended, or the core is no longer one of ours (a shrunk container).
        with contextlib.suppress(OSError):
            os.sched_setaffinity(thread, cores)


def list_cores() -> list[int]:
    """The CPU cores this process may use, by number; empty where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def cache_folder() -> Path:
    """Where compiled programs are kept: one folder per jaxlib and kind of host CPU.

    Returns:
        An absolute path below `$XDG_CACHE_HOME`, or `~/.cache`.
    """
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    version = importlib.metadata.version("jaxlib")
    return Path(home).absolute() / "mjx_revolve" / "xla" / f"{version}-{_cpu_hash()}"


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []


def _cpu_hash() -> str:
    """A hash of the CPU's model name and flags, for which XLA generates code."""
    flags = {line for line in _cpuinfo() if line.startswith(("model name", "flags", "Features"))}
    text = "\n".join([platform.machine(), cpu_model(), *sorted(flags)])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _is_whole(data: bytes) -> bool:
    """Whether a cache entry can be read to its end; unknown kinds count as whole."""
    if not data:
        return False
    if data.startswith(_ZSTD_MAGIC):  # what JAX writes where a zstd module is installed
        try:
            import zstandard
        except ImportError:
            return True
        error: type[Exception] = zstandard.ZstdError
        decompressor: Any = zstandard.ZstdDecompressor().decompressobj()
    else:
        decompressor, error = zlib.decompressobj(), zlib.error
    try:
        decompressor.decompress(data)
    except error:
        return False
    return decompressor.eof


def remove_broken_entries(folder: Path) -> list[str]:
    """Removes compilation-cache entries that a killed process left half written.

    JAX warns about such an entry and compiles anew at every start, because it never overwrites
    one. Entries that were found whole are not read again.

    Args:
        folder: the cache folder.

    Returns:
        The names of the removed entries.
    """
    marker = folder / ".checked"
    checked = marker.stat().st_mtime if marker.exists() else 0.0
    if checked > time.time():  # the clock went backwards: new entries look older than they are
        checked = 0.0
    removed = []
    newest = checked
    for entry in sorted(folder.glob("*-cache")):
        try:
            changed = entry.stat().st_mtime
            if changed <= checked:
                continue
            newest = max(newest, changed)
            if not _is_whole(entry.read_bytes()):
                entry.unlink()
                removed.append(entry.name)
        except (FileNotFoundError, PermissionError):  # removed meanwhile, or another user's
            continue
    if newest > checked:
        try:
            marker.touch()
            # One tick earlier than the newest entry: one of the same tick is read again.
            os.utime(marker, (newest - 0.001, newest - 0.001))
        except PermissionError:  # another user's, in a folder that several share
            if not os.access(folder, os.W_OK):
                raise
    return removed


def _git_revision() -> str | None:
    """The checkout's commit, with `+` when files differ from it; None outside a checkout."""
    root = _PACKAGE.parent
    if not (root / ".git").exists():  # an installed package, perhaps within another checkout
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty=+",
               "--exclude=*"]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def cpu_model() -> str:
    """The model name of the host's CPU."""
    for line in _cpuinfo():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@functools.cache
def source_hash() -> str:
    """A fingerprint of this package's Python files and worlds: two of one version may differ.

    The same in a checkout and in a wheel that was built from it. Configuration and robot are not
    part of it: they are compared by their content.
    """
    digest = hashlib.sha256()
    paths = [*_PACKAGE.rglob("*.py"), *(_PACKAGE / "water" / "worlds").glob("*.yaml")]
    # Not what editors and systems put beside them: `.#run.py`, `._run.py`.
    paths = [path for path in paths if not path.name.startswith(".")]
    for name, path in sorted((path.relative_to(_PACKAGE).as_posix(), path) for path in paths):
        digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


@functools.cache
def host_key() -> tuple[str, ...]:
    """Source, packages, CPU and cores, on which a compiled program depends."""
    cores = str(_xla_cores or usable_cores())
    return source_hash(), str(_versions()), _cpu_hash(), cores


@functools.cache
def _versions() -> dict[str, str]:
    """Versions of Python and of the packages that affect the bits of results."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def describe_process() -> dict[str, object]:
    """The command, and all that the bits of a run depend on: for `run.json`. Imports JAX.

    Returns:
        Versions, git revision, arguments, platform, CPU, device and thread settings.
    """
    import jax

    return {
        "versions": dict(_versions()),
        "git": _git_revision(),
        "argv": sys.argv,
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "cpu_count": usable_cores(),
        "device": jax.devices()[0].device_kind,
        "threads": {name: os.environ.get(name) for name in (*_THREAD_SETTINGS, "NPROC")},
        "xla_flags": os.environ.get("XLA_FLAGS"),
        "variables": unusual_modes(),
    }


def unusual_modes() -> dict[str, str] | None:
    """Variables that bits depend on, and their values, where these are not the usual ones.

    None where all are, as in `run.json` of versions that did not look. Imports JAX: a program may
    have changed its settings without the variables.
    """
    import jax

    found = {name: getattr(jax.config, name.lower()) for name in _MODES}
    modes = {
        name: str(int(value)) if isinstance(value, bool) else str(value)
        for name, value in found.items()
        if value != _MODES[name]
    }
    if os.environ.get("MJX_REVOLVE_FUSE") == "0":  # `xla.fuses`: the same but for rounding
        modes["MJX_REVOLVE_FUSE"] = "0"
    return modes or None


def usable_cores() -> int:
    """The number of CPU cores this process may use."""
    return len(list_cores()) or os.cpu_count() or 1
