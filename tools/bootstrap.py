"""Make `.venv` from `requirements.lock`: Python 3.11, pinned packages checked by hash.

Needs nothing but some Python 3.8+ and pip. Run by `make`, twice as well as once: a finished
environment is recognised by the digest of the lock file and left alone. Arguments are extras of
pyproject.toml, such as `tune,peers`, which later runs keep; what the lock has keeps its version.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
TOOL_DIR = ROOT / ".uv"
INPUTS = [ROOT / n for n in ("requirements.lock", "requirements-uv.lock", "pyproject.toml")]
STAMP = VENV / ".estima-installed"


def fail(message: str) -> None:
    """End with one line that names the remedy."""
    sys.exit(f"set-up: {message}")


def run(command: list[str], env: dict[str, str] | None = None) -> None:
    """Run one step of the set-up; its failure ends the set-up."""
    done = subprocess.run(command, cwd=ROOT, env=env, check=False)
    if done.returncode:
        fail(f"`{' '.join(command)}` ended with code {done.returncode}; see the lines above")


def pip_setting(name: str) -> str:
    """Value of a pip setting of this machine (mirror, proxy, wheel folder), or an empty string."""
    command = [sys.executable, "-m", "pip", "config", "get"]
    for scope in (":env:.", "global.", "install."):
        done = subprocess.run([*command, scope + name], capture_output=True, text=True, check=False)
        if done.returncode == 0 and done.stdout.strip():
            return done.stdout.strip()
    return ""


def environment() -> dict[str, str]:
    """Environment for uv: this machine's pip settings, in uv's words."""
    env = {**os.environ, "UV_SYSTEM_CERTS": "1", "UV_NATIVE_TLS": "1"}
    settings = (
        ("index-url", "UV_DEFAULT_INDEX"),
        ("extra-index-url", "UV_INDEX"),
        ("find-links", "UV_FIND_LINKS"),
    )
    for pip_name, uv_name in settings:
        value = pip_setting(pip_name)
        if value:
            env.setdefault(uv_name, value)
    # Hashes decide what may be installed, so any configured index may serve any package.
    env.setdefault("UV_INDEX_STRATEGY", "unsafe-best-match")
    return env


def pinned_uv() -> str:
    """Path of the pinned uv, installed beside the project on the first call."""
    version = (ROOT / "requirements-uv.lock").read_text().split()[0].split("==")[1]
    uv = TOOL_DIR / "bin" / "uv"
    for candidate in (str(uv), shutil.which("uv")):
        if candidate and Path(candidate).exists():
            said = subprocess.run([candidate, "--version"], capture_output=True, text=True)
            if said.stdout.split()[1:2] == [version]:
                return candidate
    print(f"set-up: installing uv {version}", flush=True)
    shutil.rmtree(TOOL_DIR, ignore_errors=True)
    made = subprocess.run(
        [sys.executable, "-m", "venv", str(TOOL_DIR)], capture_output=True, check=False
    )
    pip = [str(TOOL_DIR / "bin" / "python"), "-m", "pip"]
    if made.returncode:  # a Python without ensurepip: let its own pip fill the folder
        shutil.rmtree(TOOL_DIR, ignore_errors=True)
        pip = [sys.executable, "-m", "pip"]
        if subprocess.run([*pip, "--version"], capture_output=True, check=False).returncode:
            fail(
                f"{sys.executable} has neither venv nor pip; install your system's python3-venv "
                f"package, or put uv {version} on the PATH, and run make again"
            )
    install = ["install", "--quiet", "--require-hashes", "--only-binary=:all:"]
    target = [] if made.returncode == 0 else ["--target", str(TOOL_DIR)]
    run([*pip, *install, *target, "-r", str(ROOT / "requirements-uv.lock")])
    if not uv.exists():
        fail("pip reported success but uv is not where it should be; remove .uv and run make again")
    return str(uv)


def wanted_extras(known: str, before: str) -> list[str]:
    """Extras of the command line and of an earlier set-up, which pyproject.toml must have."""
    section = known.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    names = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    asked = [name for words in sys.argv[1:] for name in words.replace(",", " ").split()]
    for name in asked:
        if name not in names:
            fail(f"no extra {name}; there are: {', '.join(names)}")
    return sorted({*asked, *(name for name in before.split() if name in names)})


def main() -> None:
    """Bring `.venv` to the state that the lock files name, or do nothing if it is there."""
    digest = hashlib.sha256(b"\0".join(p.read_bytes() for p in INPUTS)).hexdigest()
    stamped = STAMP.read_text() if STAMP.exists() else ""
    before = stamped.partition("\n")[2]
    extras = wanted_extras((ROOT / "pyproject.toml").read_text(), before)
    state = f"{digest} {ROOT}\n{' '.join(extras)}"
    if stamped == state:
        return
    uv, env = pinned_uv(), environment()
    print("set-up: making .venv (Python 3.11) from requirements.lock, two to four min", flush=True)
    if not (VENV / "bin" / "python").exists():
        run([uv, "venv", "--quiet", "--clear", "--python", "3.11", str(VENV)], env)
    env["VIRTUAL_ENV"] = str(VENV)
    lock = str(ROOT / "requirements.lock")
    run([uv, "pip", "sync", "--quiet", "--compile-bytecode", "--require-hashes", lock], env)
    # by plain path, so that a clone named estima does not hide the package from its parent folder
    plain = ["--config-setting", "editable_mode=compat"]
    what = f"{ROOT}[{','.join(extras)}]" if extras else str(ROOT)
    pinned = ["--constraint", lock] if extras else ["--no-deps"]
    local = ["--no-build-isolation", *pinned, *plain, "--editable", what]
    run([uv, "pip", "install", "--quiet", *local], env)
    print("set-up: compiling numerical code, some 15 s", flush=True)
    run([str(VENV / "bin" / "python"), "-m", "experiments.bench.compile"])
    STAMP.write_text(state)
    print("set-up: done", flush=True)


if __name__ == "__main__":
    main()
