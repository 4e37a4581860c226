"""Makes furnished rooms with Infinigen and renders views of them: ``python make.py --rooms 40 --out FOLDER``.

Makes one room after another on one thread: about 15 core-minutes for a room, and 5 for 60 views of 224x112. To resume
after an interruption, run the same command again; finished rooms and views are kept. Needs only the standard library;
Infinigen and Blender are installed into an environment of their own (``OUT/environment``, or ``--env``).

Results: ``OUT/train/room_NNNN``, ``OUT/held_out/room_NNNN`` and ``OUT/test/room_NNNN``, and their paths as scenes in
``OUT/paths``, folders for ``data=infinigen``; ``OUT/log.csv`` with the time of every stage. A room that fails leaves
``OUT/work/room_NNNN/failed.txt`` and is skipped from then on. A room that does not pass the check goes to
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
KINDS = {"DiningRoom": "dining-room", "LivingRoom": "living-room"}
KINDS |= {"Bedroom": "bedroom", "Kitchen": "kitchen", "Bathroom": "bathroom"}
TEST = {int(seed): name for seed, name in json.loads((HERE / "test_rooms.json").read_text()).items()}
"""Rooms that report a result and never choose one, by seed."""
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


def kind(seed: int) -> str:
    """Returns Infinigen's name of the kind of room for a seed; kinds alternate, except in the test rooms."""
    return TEST.get(seed) or list(KINDS)[seed % len(KINDS)]


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


def link_paths(room: Path) -> None:
    """Links the views of every kind of path of a room into a scene ``paths/PART/ROOM/KIND``, unless it exists.

    Loaders draw neighbouring frames, but views of different paths of a room hardly overlap. Turns on the spot are left
    out, as they have no parallax.
    """
    kinds: dict[str, set[int]] = {}
    for number, view in enumerate(json.loads((room / "views.json").read_text())):
        kinds.setdefault(view["path"].rsplit("_", 1)[0], set()).add(number)
    kinds.pop("turn", None)
    for path_kind, numbers in kinds.items():
        scene = room.parents[1] / "paths" / room.parent.name / room.name / path_kind
        new = scene.with_name(f"{path_kind}.new")  # renamed when complete
        if scene.exists():
            continue
        shutil.rmtree(new, ignore_errors=True)
        for file in sorted(room.glob("frames/*/camera_*/*")):
            if int(file.stem.split("_")[3]) in numbers:  # such as Image_0_0_0007_0
                link = new / file.relative_to(room)
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to(os.path.relpath(file, link.parent))
        new.rename(scene)


class Rooms:
    """Makes rooms in a folder.

    Args:
        out: output folder.
        interpreter: Python interpreter of Infinigen's environment.
        views: number of views per room.
        size: image ``(height, width)``.

    Raises:
        SystemExit: if another process makes rooms in the folder.
    """

    def __init__(self, out: Path, interpreter: Path, views: int = 60, size: tuple[int, int] = (112, 224)) -> None:
        self.out, self.interpreter = out, interpreter
        self.view_options = ["--views", views, "--size", *size]
        # a working folder with links to Infinigen's packages, where it looks for its settings
        self.links = out / "work" / "packages"
        self.links.mkdir(parents=True, exist_ok=True)
        self._lock = (out / "work" / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise SystemExit(f"another process is making rooms in {out}: wait for it, or use another --out") from None
        for package in ("infinigen", "infinigen_examples"):
            (self.links / package).unlink(missing_ok=True)
            (packages,) = interpreter.parents[1].glob("lib/python*/site-packages")
            (self.links / package).symlink_to(packages / package)

    def make(self, seed: int) -> None:
        """Makes one room, unless it exists or failed before."""
        room = f"room_{seed:04d}"
        work = self.out / "work" / room
        if any((self.out / place / room).exists() for place in ("train", "held_out", "test", "rejected")):
            return
        if (work / "failed.txt").exists():
            print(f"{room} failed before ({work / 'failed.txt'}); remove that file to try it again", flush=True)
            return
        work.mkdir(parents=True, exist_ok=True)
        try:
            if not (work / "coarse").exists():
                self._coarse(seed, work)
            self._views(seed, room, work)
        except (subprocess.CalledProcessError, FileNotFoundError) as error:
            (work / "failed.txt").write_text(f"{error}; see the logs in {work}\n")
            print(f"{room} failed: {error}; see the logs in {work}", flush=True)

    def _coarse(self, seed: int, work: Path) -> None:
        new = work / "coarse.new"
        shutil.rmtree(new, ignore_errors=True)
        command = [
            "coarse.py", "--seed", seed, "--task", "coarse", "--output_folder", new,
            "-g", "fast_solve.gin", "singleroom.gin", "-p", *_FASTER,
            f'restrict_solving.restrict_parent_rooms=["{kind(seed)}"]',
        ]  # fmt: skip
        self._stage(command, work / "coarse.log")
        (new / "scene.blend").stat()  # raises an error if it was not written
        new.rename(work / "coarse")

    def _views(self, seed: int, room: str, work: Path) -> None:
        views = work / "views"
        scene = ["views.py", work / "coarse" / "scene.blend", views, "--seed", seed, "--kind", kind(seed)]
        self._stage([*scene, *self.view_options], work / "views.log")
        self._stage(["check.py", views], work / "check.json")
        figures = json.loads((work / "check.json").read_text().splitlines()[-1])
        (views / "check.json").write_text(json.dumps(figures | {"seed": seed, "kind": kind(seed)}) + "\n")
        print(f"{room} ({kind(seed)}): {figures}", flush=True)
        accepted = "test" if seed in TEST else "held_out" if seed in HELD_OUT else "train"
        place = self.out / (accepted if figures["ok"] else "rejected")
        place.mkdir(exist_ok=True)
        views.rename(place / room)
        shutil.rmtree(work / "coarse")
        if figures["ok"]:
            link_paths(place / room)

    def _stage(self, command: Sequence[object], log: Path) -> None:
        """Runs a script in Infinigen's environment; adds its wall and core seconds to ``OUT/log.csv``."""
        script, *options = map(str, command)
        before = os.times()
        with log.open("w") as file:
            subprocess.run(
                [str(self.interpreter), str(HERE / script), *options], check=True,
                cwd=self.links, env={**os.environ, **_THREADS}, stdout=file, stderr=subprocess.STDOUT,
            )  # fmt: skip
        after = os.times()
        core = after.children_user + after.children_system - before.children_user - before.children_system
        with (self.out / "log.csv").open("a") as file:
            file.write(f"{log.parent.name},{script},{after.elapsed - before.elapsed:.0f},{core:.0f}\n")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--rooms", type=int, default=40, help="number of rooms, seeds 0 to N-1; ten of the first 40 are held out"
    )
    parser.add_argument("--seeds", type=int, nargs="+", help="these seeds instead, such as those of the test rooms")
    parser.add_argument("--out", type=Path, required=True, help="output folder")
    parser.add_argument("--views", type=int, default=60, help="views per room")
    parser.add_argument("--size", type=int, nargs=2, default=(112, 224), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--env", type=Path, help="folder of Infinigen's environment (3 GB)")
    parser.add_argument("--python", default="python3.11", help="interpreter that the environment is made with")
    args = parser.parse_args()
    out = args.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    for place in ("train", "held_out", "test"):
        for room in sorted((out / place).glob("room_*")):
            link_paths(room)
    interpreter = make_environment((args.env or out / "environment").resolve(), args.python)
    rooms = Rooms(out, interpreter, args.views, args.size)
    for seed in args.seeds or range(args.rooms):
        rooms.make(seed)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also ends the running stage
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted; run the same command to resume")
