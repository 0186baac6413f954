"""Files of an animation: MP4, GIF, an HTML page, or a recording for Rerun."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from experiments.viewing.animation import Picture, pictures
from experiments.viewing.playback import Playback
from experiments.viewing.player import write_page
from experiments.viewing.rerun_file import check_installed, write_rerun
from sim.errors import require
from sim.files import check_writable, write_whole


def check_output(path: Path) -> None:
    """Refuse a file that could not be written, before anything is computed."""
    kinds = (*_WRITERS, *_PAGES)
    require(path.suffix in kinds, f"{path}: animations are {', '.join(kinds)}")
    require(
        path.suffix != ".mp4" or shutil.which("ffmpeg") is not None,
        f"{path}: MP4 needs ffmpeg, which is not installed; take .gif or .html",
    )
    if path.suffix == ".rrd":
        check_installed(path)
    check_writable(path)


def save(
    run: Playback, path: Path, on_progress: Callable[[float], None], title: str = "A run"
) -> None:
    """Write a run as `.mp4` (needs ffmpeg), `.gif`, `.html` or `.rrd`, whole or not at all.

    Parameters
    ----------
    on_progress
        Called with the share done.
    title
        Of an `.html` or `.rrd`.
    """
    check_output(path)

    with write_whole(path) as part:
        if path.suffix in _PAGES:
            _PAGES[path.suffix](run, part, on_progress, title)
        else:
            _WRITERS[path.suffix](run, _counted(run, on_progress), part)


def _counted(run: Playback, on_progress: Callable[[float], None]) -> Iterator[Picture]:
    for done, picture in enumerate(pictures(run), start=1):
        yield picture
        on_progress(done / len(run.stamps))


def _write_mp4(run: Playback, images: Iterator[Picture], path: Path) -> None:
    first = next(images)
    size = f"{first.shape[1]}x{first.shape[0]}"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{run.fps:.4f}", "-i", "-"]
    command = ["ffmpeg", "-y", "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            process.stdin.write(first.tobytes())
            for image in images:
                process.stdin.write(image.tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # its message says why
        message = process.stderr.read().decode(errors="replace").strip()
    require(
        not process.returncode,
        f"ffmpeg: {(message.splitlines() or ['failed'])[-1]}; take .gif or .html",
    )


def _reduced(image: Picture) -> Any:
    """The picture with a palette of its own: a third of the size, with no visible difference."""
    from PIL import Image

    return Image.fromarray(image).quantize(96, method=Image.Quantize.FASTOCTREE)


def _write_gif(run: Playback, images: Iterator[Picture], path: Path) -> None:
    first, *rest = (_reduced(image) for image in images)
    duration_ms = round(1000.0 / run.fps)
    first.save(path, "GIF", save_all=True, append_images=rest, duration=duration_ms, loop=0)


_WRITERS = {".mp4": _write_mp4, ".gif": _write_gif}
_PAGES = {".html": write_page, ".rrd": write_rerun}  # that draw by themselves
