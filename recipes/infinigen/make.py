"""Makes furnished rooms with Infinigen and renders views of them: ``python make.py --rooms 40 --out FOLDER``.

Makes one room after another on one thread: about 15 core-minutes for a room, and 5 for 60 views of 224x112. To resume
after an interruption, run the same command again; finished rooms and views are kept. Needs only the standard library;
Infinigen and Blender are installed into an environment of their own (``OUT/environment``, or ``--env``).

Results: ``OUT/train/room_NNNN`` and ``OUT/held_out/room_NNNN``, folders for ``data=infinigen``. A room that fails
leaves ``OUT/work/room_NNNN/failed.txt`` and is skipped from then on. A room that does not pass the check goes to
``OUT/rejected``.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
INFINIGEN, BLENDER = "infinigen==1.15.5", "bpy==4.2.0"
# Infinigen's name of a kind of room, and prefix of the names of its floors.
KINDS = {
    "DiningRoom": "dining-room",
    "LivingRoom": "living-room",
    "Bedroom": "bedroom",
    "Kitchen": "kitchen",
    "Bathroom": "bathroom",
}
HELD_OUT = (3, 7, 10, 14, 16, 24, 28, 30, 32, 36)
"""Seeds excluded from training: two rooms of each kind among the first forty."""
_THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS", "NUMBA")}
# No landscape outside, fewer steps than in fast_solve.gin (100 and 40), and small objects on only four pieces of
# furniture, as placing them takes most of the time.
_FASTER = (
    "compose_indoors.terrain_enabled=False",
    "compose_indoors.solve_steps_large=60", "compose_indoors.solve_steps_medium=25",
    "restrict_solving.solve_max_parent_obj=4",
)  # fmt: skip


class StageError(Exception):
    """A stage of a room failed."""


def kind(seed: int) -> str:
    """Returns Infinigen's name of the kind of room for a seed; kinds alternate."""
    return list(KINDS)[seed % len(KINDS)]


def part(seed: int) -> str:
    """Returns the folder name of a room's split."""
    return "held_out" if seed in HELD_OUT else "train"


def make_environment(env: Path, python: str) -> Path:
    """Installs Infinigen and Blender into ``env`` unless installed; returns its interpreter.

    Raises:
        SystemExit: if ``python`` is not Python 3.11, or Blender cannot be imported.
    """
    interpreter, done = env / "bin" / "python", env / "complete"
    if done.exists():
        return interpreter
    version = subprocess.run([python, "-c", "import sys; print(sys.version_info[:2])"], capture_output=True, text=True)
    if version.stdout.strip() != "(3, 11)":
        raise SystemExit(f"{python} is not Python 3.11, which Blender 4.2 needs: name one with --python")
    subprocess.run([python, "-m", "venv", str(env)], check=True)
    pip = [str(interpreter), "-m", "pip", "install", "-q"]
    subprocess.run([*pip, "--no-deps", INFINIGEN, BLENDER], check=True)
    subprocess.run([*pip, "-r", str(HERE / "requirements.txt")], check=True)
    subprocess.run([str(interpreter), "-m", "pip", "uninstall", "-q", "-y", "typing"], check=True)
    if subprocess.run([str(interpreter), "-c", "import bpy, infinigen"], capture_output=True).returncode:
        raise SystemExit(
            f"Blender cannot be imported in {env}; on Debian: apt-get install libxi6 libxxf86vm1 libxfixes3 "
            "libxrender1 libsm6 libegl1 libxkbcommon0 libgl1"
        )
    done.touch()
    return interpreter


def link_packages(interpreter: Path, folder: Path) -> None:
    """Creates a working folder with links to Infinigen's packages, where it looks for its settings."""
    folder.mkdir(parents=True, exist_ok=True)
    where = subprocess.run(
        [str(interpreter), "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    for package in ("infinigen", "infinigen_examples"):
        link = folder / package
        if not link.exists():
            link.unlink(missing_ok=True)
            link.symlink_to(Path(where.stdout.strip()) / package)


class Rooms:
    """Makes rooms in a folder.

    Args:
        out: output folder.
        interpreter: Python interpreter of Infinigen's environment.
        args: command-line options.

    Raises:
        SystemExit: if another process makes rooms in the folder.
    """

    def __init__(self, out: Path, interpreter: Path, args: argparse.Namespace) -> None:
        self.out, self.interpreter, self.args = out, interpreter, args
        self.links = out / "work" / "packages"
        link_packages(interpreter, self.links)
        self._lock = (out / "work" / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SystemExit(
                f"another process is making rooms in {out}: wait for it, stop it, or use another --out"
            ) from None

    def make(self, seed: int) -> None:
        """Makes one room, unless it exists or failed before."""
        room = f"room_{seed:04d}"
        work = self.out / "work" / room
        if any((self.out / place / room).exists() for place in (part(seed), "rejected")):
            return
        if (work / "failed.txt").exists():
            print(f"{room} failed before ({work / 'failed.txt'}); remove that file to try it again", flush=True)
            return
        work.mkdir(parents=True, exist_ok=True)
        try:
            if not (work / "coarse").exists():
                self._coarse(seed, work)
            self._views(seed, room, work)
        except StageError as error:
            (work / "failed.txt").write_text(f"{error}\n")
            print(f"{room} failed: {error}", flush=True)

    def _coarse(self, seed: int, work: Path) -> None:
        new = work / "coarse.new"
        shutil.rmtree(new, ignore_errors=True)
        command = [
            HERE / "coarse.py", "--seed", seed, "--task", "coarse", "--output_folder", new,
            "-g", "fast_solve.gin", "singleroom.gin", "-p", *_FASTER,
            f'restrict_solving.restrict_parent_rooms=["{kind(seed)}"]',
        ]  # fmt: skip
        self._stage("coarse", command, work / "coarse.log")
        if not (new / "scene.blend").exists():
            raise StageError(f"coarse wrote no scene.blend; see {work / 'coarse.log'}")
        new.rename(work / "coarse")

    def _views(self, seed: int, room: str, work: Path) -> None:
        args, views = self.args, work / "views"
        command = [
            HERE / "views.py", work / "coarse" / "scene.blend", views, "--seed", seed, "--kind", kind(seed),
            "--views", args.views, "--size", *args.size, "--samples", args.samples,
        ]  # fmt: skip
        self._stage("views", command, work / "views.log")
        log = work / "check.json"
        self._stage("check", [HERE / "check.py", views], log)
        figures = json.loads(log.read_text().splitlines()[-1])
        (views / "check.json").write_text(json.dumps(figures | {"seed": seed, "kind": kind(seed)}) + "\n")
        print(f"{room} ({kind(seed)}): {figures}", flush=True)
        place = self.out / (part(seed) if figures["ok"] else "rejected")
        place.mkdir(exist_ok=True)
        views.rename(place / room)
        if not args.keep_blend:
            shutil.rmtree(work / "coarse")

    def _stage(self, stage: str, command: Sequence[object], log: Path) -> None:
        """Runs one stage in Infinigen's environment."""
        with log.open("w") as file:
            ended = subprocess.run(
                [str(self.interpreter), *map(str, command)],
                cwd=self.links, env={**os.environ, **_THREADS}, stdout=file, stderr=subprocess.STDOUT,
            )  # fmt: skip
        if ended.returncode:
            raise StageError(f"{stage}: exit {ended.returncode}; see {log}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rooms", type=int, default=40, help="number of rooms, seeds 0 to N-1; ten of the first 40 are held out"
    )
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--views", type=int, default=60, help="views per room")
    parser.add_argument("--size", type=int, nargs=2, default=(112, 224), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--samples", type=int, default=8, help="samples per pixel")
    parser.add_argument("--keep-blend", action="store_true", help="keep every room's scene.blend (400 to 500 MB)")
    parser.add_argument("--env", type=Path, help="folder of Infinigen's environment (3 GB)")
    parser.add_argument("--python", default="python3.11", help="interpreter that the environment is made with")
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    interpreter = make_environment((args.env or out / "environment").resolve(), args.python)
    rooms = Rooms(out, interpreter, args)
    for seed in range(args.rooms):
        rooms.make(seed)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also ends the running stage
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted; run the same command to resume")
