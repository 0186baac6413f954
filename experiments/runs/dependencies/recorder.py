"""What a result depends on, found while it is made: code, files, programs, packages.

Code is the modules that were used, and what those import; a module that only happens to be loaded
does not count. A name is a path below the checkout (`sim/se2.py`), below the results
(`results/tables/a.csv`) or elsewhere (absolute), `package NAME`, or `program NAME` on PATH.
"""

import builtins
import functools
import hashlib
import importlib.machinery
import importlib.util
import json
import os
import shlex
import shutil
import sys
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from experiments.runs.dependencies.digests import digest_of, name_of, package_version
from experiments.runs.dependencies.sources import keep_sources, read_source, resolved
from experiments.runs.paths import SOURCE

Digests = Mapping[str, str]  # of each dependency, by its name
_HOUSE = ("sim", "estimators", "experiments", "estima")
_BUILT = (".py", ".pyc", ".so", ".nbi", ".nbc", ".pth")  # modules, and their caches
_OURS = (".lock", ".journal", ".job")
_SYSTEM = ("/proc/", "/sys/", "/dev/", "/etc/", "/usr/", "/lib", str(Path.home() / ".cache"))
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Recorder:
    """What was seen while it was active.

    Attributes
    ----------
    modules
        Names of modules whose code was used.
    noted
        What other processes, or the cache, have recorded.
    parts
        What each table depends on besides, and the seconds that it took, by its name.
    keep_in
        Folder for the tables of jobs that are finished; None to keep none.
    """

    def __init__(self, *modules: str) -> None:
        self.modules = set(modules)
        self.noted: dict[str, str] = {}
        self.parts: dict[str, tuple[dict[str, str], float]] = {}
        self.keep_in: Path | None = None
        self.read = set[str]()
        self.written = set[str]()
        self.commands: list[tuple[str, tuple[str, ...], str | None]] = []

    def digests(self) -> dict[str, str]:
        """Digest of each dependency, by its name."""
        code, own = _code(frozenset(self.modules), _WATCH.n_imports)
        read = self.read.union(*(_WATCH.opened.get(name, ()) for name in own))
        found = {"package python": package_version("python") or "", **self.noted, **code}
        for path in map(Path, sorted(read - self.written)):
            with suppress(OSError):
                name = name_of(path)
                if path.is_file() and not name.startswith("results/cache/"):
                    found[name] = digest_of(path)
        for program, words, folder in self.commands:
            found |= _command_digests(program, words, folder)
        return dict(sorted(found.items()))


@contextmanager
def recorded(*modules: str) -> Iterator[Recorder]:
    """Record what is used inside, by this process.

    Parameters
    ----------
    modules
        Modules whose code runs inside from the beginning.
    """
    recorder = Recorder(*modules)
    _WATCH.begin(recorder)
    try:
        yield recorder
    finally:
        _WATCH.end(recorder)
        keep_sources()


def note(digests: Digests) -> None:
    """Add to what is being recorded what was recorded elsewhere."""
    for recorder in _WATCH.recorders:
        recorder.noted.update(digests)


def note_unloaded(module: str, settings: Mapping[str, Any]) -> None:
    """Add a module that another process loads: its sources, found without running them.

    Parameters
    ----------
    settings
        Its options; the files that they name count too.
    """
    found: dict[str, str] = {}

    @functools.cache
    def find(name: str) -> importlib.machinery.ModuleSpec | None:
        """Spec of a module, without importing the packages that it is in."""
        package = name.rpartition(".")[0]
        above = find(package) if package else None
        places = None if above is None else above.submodule_search_locations
        if package and places is None:  # of a module that is not a package
            return None
        return importlib.machinery.PathFinder.find_spec(name, places)

    todo, seen = {module}, set[str]()
    while todo:
        name = todo.pop()
        spec = None if name in seen else find(name)
        seen.add(name)
        origin = (spec and spec.origin) or ""
        if origin.endswith(".py") and not _is_installed(origin):
            file = Path(origin)
            found[name_of(file)], _, imports = read_source(file.read_bytes())
            package = name if file.name == "__init__.py" else name.rpartition(".")[0]
            todo.update({name.rpartition(".")[0], *resolved(imports, package)} - {""})
    for value in settings.values():
        for word in value if isinstance(value, list) else [value]:
            with suppress(OSError, ValueError):
                if isinstance(word, str) and Path(word).is_file():
                    found[name_of(Path(word).absolute())] = digest_of(Path(word))
    note(found)


def note_part(name: str, digests: Digests, seconds: float) -> None:
    """Add what a job has recorded and how long it took, of one of the tables that it gave."""
    for recorder in _WATCH.recorders:
        known, spent_s = recorder.parts.get(name, ({}, 0.0))
        recorder.parts[name] = known | dict(digests), spent_s + seconds


def is_recording() -> bool:
    """Whether anything is being recorded."""
    return bool(_WATCH.recorders)


def kept_in() -> Path | None:
    """Folder of the innermost recorder that keeps the tables of finished jobs, if any."""
    return next((r.keep_in for r in reversed(_WATCH.recorders) if r.keep_in), None)


def digest_of_all(digests: Digests) -> str:
    """Return 12 hex digits of a digest of dependencies."""
    text = json.dumps(sorted(digests.items()))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


class _Watch:
    """What this process sees; the recorders that are active take from it what they need.

    Code from elsewhere may import and read in ways that are not seen again, once and for all runs
    of the process. So what it once imported or read counts whenever it is used.

    Attributes
    ----------
    imported
        Modules that code from elsewhere has imported, by its own module.
    opened
        Files that it has read, by its module; of code from here, those read as it was loaded.
    loaded
        Digest and imports of each module, when it was first asked for.
    """

    def __init__(self) -> None:
        self.recorders: list[Recorder] = []
        self.imported: dict[str, set[str]] = {}
        self.opened: dict[str, set[str]] = {}
        self.loaded = weakref.WeakKeyDictionary[ModuleType, tuple[str, tuple[str, ...]]]()
        self.n_imports = 0
        self._import = builtins.__import__
        sys.addaudithook(self._see)

    def begin(self, recorder: Recorder) -> None:
        """Begin to tell a recorder."""
        if not self.recorders:
            self._import, builtins.__import__ = builtins.__import__, self._see_import
        self.recorders.append(recorder)

    def end(self, recorder: Recorder) -> None:
        """End it."""
        self.recorders.remove(recorder)
        if not self.recorders:
            builtins.__import__ = self._import

    def _see_import(
        self,
        name: str,
        globals: Mapping[str, object] | None = None,  # noqa: A002 its own names
        locals: Mapping[str, object] | None = None,  # noqa: A002
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """Import as ever, and note what a statement inside a function imports."""
        module = self._import(name, globals, locals, fromlist, level)
        if globals is None or _kind(str(globals.get("__name__", ""))) != "library":
            whole = "." * level + name
            if level and globals is not None:
                package = str(globals.get("__package__") or "")
                whole = importlib.util.resolve_name(whole, package)
            for recorder in self.recorders:
                recorder.modules.update([whole, *(f"{whole}.{part}" for part in fromlist or ())])
        return module

    def _see(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Audit hook; it must not raise."""
        if event == "open":
            with suppress(TypeError, ValueError, OSError):
                self._see_open(*arguments)
        elif event == "import":
            self.n_imports += 1
            if _kind(importer := _caller()) == "own":
                self.imported.setdefault(importer, set()).add(arguments[0])
        elif event == "subprocess.Popen" and self.recorders:
            with suppress(TypeError, ValueError, OSError):
                self._see_program(*arguments)

    def _see_open(self, path: Any, mode: str | None, flags: int) -> None:
        if isinstance(path, int):
            return
        text = os.path.abspath(os.fsdecode(path))
        if text.endswith(_BUILT + _OURS) or not _counts(text):
            return
        writing = any(sign in mode for sign in "wax+") if mode else bool(flags & _WRITING)
        for recorder in self.recorders:
            (recorder.written if writing else recorder.read).add(text)
        if not writing and (reader := _reader()):
            self.opened.setdefault(reader, set()).add(text)

    def _see_program(self, program: Any, words: Any, folder: Any, _: Any) -> None:
        if _kind(_caller()) == "library":  # such as one that counts the processor's cores
            return
        given = shlex.split(words) if isinstance(words, str) else [os.fsdecode(w) for w in words]
        line = os.fsdecode(program), tuple(given[1:]), folder and os.fsdecode(folder)
        for recorder in self.recorders:
            recorder.commands.append(line)


def _frames() -> Iterator[FrameType]:
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        yield frame
        frame = frame.f_back


def _caller() -> str:
    """Module of the code that acts, the standard library aside."""
    names = (str(frame.f_globals.get("__name__", "")) for frame in _frames())
    own = (n for n in names if n != __name__ and n.partition(".")[0] not in sys.stdlib_module_names)
    return next(own, "")


def _reader() -> str:
    """Module from elsewhere that reads a file, or any that reads one as it is loaded.

    A program that calls the runner is not what reads.
    """
    for frame in _frames():
        name = str(frame.f_globals.get("__name__", ""))
        if name in ("__main__", "__mp_main__", __name__):
            continue
        kind = _kind(name)
        if kind == "own" or (kind == "house" and frame.f_code.co_name == "<module>"):
            return name
        if name.startswith("experiments."):
            break
    return ""


@functools.cache
def _kind(name: str) -> str:
    """Whose a loaded module is: `house`, `own` (the user's) or `library`."""
    top, file = name.partition(".")[0], getattr(sys.modules.get(name), "__file__", None)
    if top in _HOUSE or (file is not None and file.startswith(f"{SOURCE}/experiments/")):
        return "house"
    library = top in sys.stdlib_module_names - {"__main__"} or file is None or _is_installed(file)
    return "library" if library else "own"


def _is_installed(file: str) -> bool:
    """Whether a file belongs to an installed package or to Python."""
    return "-packages/" in file or file.startswith((sys.prefix, sys.base_prefix + "/lib"))


def _counts(path: str) -> bool:
    """Whether a file can be a dependency: not one of the system, or of installed packages."""
    if path.startswith(f"{SOURCE}/") and not path.startswith(f"{SOURCE}/."):
        return True
    return not (path.startswith(_SYSTEM) or _is_installed(path))


@functools.cache
def _code(modules: frozenset[str], _: int) -> tuple[dict[str, str], frozenset[str]]:
    """Digests of modules and of all that they import, and the modules' names.

    The second argument is the number of imports so far, which may load a module again.
    """
    found: dict[str, str] = {}
    seen, todo = set[str](), {*modules}
    while todo:
        name = todo.pop()
        module = sys.modules.get(name)
        if module is None or name in seen:
            continue
        seen.add(name)
        todo.add(name.rpartition(".")[0])
        if _kind(name) == "library":
            top = name.partition(".")[0]
            if top not in sys.stdlib_module_names and (version := package_version(top)):
                found[f"package {top}"] = version
        elif file := getattr(module, "__file__", None):
            if module not in _WATCH.loaded:
                _WATCH.loaded[module] = _source(Path(file))
            found[name_of(Path(file))], imports = _WATCH.loaded[module]
            package = name if hasattr(module, "__path__") else name.rpartition(".")[0]
            todo.update(_WATCH.imported.get(name, ()))
            todo |= resolved(imports, package)
    return found, frozenset(name for name in seen if _kind(name) != "library")


def _source(file: Path) -> tuple[str, tuple[str, ...]]:
    """Digest and imports of a module's file."""
    with suppress(OSError):
        return read_source(file.read_bytes())[:2] if file.suffix == ".py" else (digest_of(file), ())
    return "", ()


def _command_digests(program: str, words: tuple[str, ...], folder: str | None) -> dict[str, str]:
    """Digests of a program, and of the files among its arguments."""
    found = {}
    where = Path(folder or ".")
    if os.sep not in program and (path := shutil.which(program)):
        found[f"program {program}"] = digest_of(Path(path))
    for word in (program, *words):
        if word == sys.executable:  # it lies elsewhere on each machine
            continue
        with suppress(OSError, ValueError):
            if (os.sep in word or Path(word).suffix) and (where / word).is_file():
                found[name_of((where / word).absolute())] = digest_of(where / word)
    return found


_WATCH = _Watch()
