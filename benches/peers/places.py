"""Simulated places and data sets as folders, and what the program `omniloc` makes of them."""

import csv
import hashlib
import json
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

OMNILOC = os.environ.get("OMNILOC", "target/release/omniloc")
WORK = Path("target/peers-days")
WORLDS = Path(os.environ.get("OMNILOC_WORLDS", WORK / "worlds"))
RECIPES = ("default", "paper")

# Day 1 is learned from. Every day has its own light, weather, traffic, gain of the camera and tilt of the lens (its
# number chooses them), and these; lanes in metres.
DAYS = {
    1: ("summer", 1.0, 0.0),
    2: ("autumn", 1.0, 0.4),
    3: ("winter", 0.5, -0.3),
    4: ("spring", 2.0, 0.2),
    5: ("summer", 1.5, -0.4),
}
GAIN_DB, TILT_DEG = 2.0, 0.7
HALL_SPACING_M = 1.6


class Failed(Exception):
    pass


def omniloc(*arguments):
    command = [OMNILOC, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise Failed(f"{' '.join(command)}\n{done.stderr.strip()}")


@cache
def program():
    """Changes when the program does."""
    return hashlib.sha256(Path(OMNILOC).read_bytes()).hexdigest()[:16]


class Dataset:
    """A folder with images/, positions.csv, donut.json and, for measuring, truth.csv."""

    def __init__(self, folder):
        self.folder = Path(folder)
        rows = list(csv.DictReader(open(self.folder / "positions.csv")))
        self.rows = rows
        self.positions_m = coordinates(rows)
        self.images = [self.folder / "images" / Path(row["file"]).name for row in rows]
        truth = self.folder / "truth.csv"
        self.truth_m = coordinates(csv.DictReader(open(truth))) if truth.exists() else self.positions_m

    def part(self, chosen, folder):
        """A data set of some of the images, in `folder`."""
        folder = Path(folder)
        (folder / "images").mkdir(parents=True)
        shutil.copy(self.folder / "donut.json", folder)
        with open(folder / "positions.csv", "w") as positions:
            writer = csv.DictWriter(positions, self.rows[0].keys())
            writer.writeheader()
            for i in chosen:
                (folder / "images" / self.images[i].name).symlink_to(self.images[i].resolve())
                writer.writerow({**self.rows[i], "file": self.images[i].name})
        return Dataset(folder)


def coordinates(rows):
    return np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows])


def simulated(place, day, frames):
    """The data set of one day at `place` (town-101, corridor-3, hall-1); rendered if it is not there."""
    kind, seed = place.rsplit("-", 1)
    season, traffic, lane_shift_m = DAYS[day]
    number = 10 * int(seed) + day
    options = ["--world", kind, "--seed", seed, "--day", number, "--traffic", traffic, "--gain-db", GAIN_DB,
               "--tilt-deg", TILT_DEG]
    if kind == "town":
        options += ["--season", season, "--lane-shift-m", lane_shift_m, "--frames", frames]
    elif kind == "corridor":
        options += ["--lane-shift-m", round(lane_shift_m / 4, 2), "--frames", frames]
    elif day == 1:
        options += ["--spacing-m", HALL_SPACING_M]
    else:
        options += ["--frames", frames]
    made_with = " ".join(map(str, options))
    folder = WORLDS / f"{place}-day-{day}-of-{frames}"
    noted = folder / "made-with.txt"
    if not noted.exists() or noted.read_text() != made_with:
        folder.parent.mkdir(parents=True, exist_ok=True)
        omniloc("simulate", *options, "--out", folder, "--force")
        noted.write_text(made_with)
    return Dataset(folder)


def estimates_of(entry):
    frames = sorted(entry["frames"], key=lambda frame: frame["index"])
    return np.array([[frame["est_e_m"], frame["est_n_m"]] for frame in frames])


def ours(recipe, learning, tests):
    """Estimates of the program for every frame of `tests`, from a map of `learning`."""
    with tempfile.TemporaryDirectory(dir=WORK) as folder:
        folder = Path(folder)
        omniloc("import", learning.folder, "--out", folder / "learning.mcap")
        omniloc("train", "--recipe", recipe, folder / "learning.mcap", "--out", folder / "area.map")
        of_features = {}
        for test in tests:
            omniloc("import", test.folder, "--out", folder / "test.mcap", "--force")
            omniloc("evaluate", "--map", folder / "area.map", folder / "test.mcap", "--json", folder / "test.json",
                    "--frames", "--force")
            entries = json.loads((folder / "test.json").read_text())["results"]
            collect(of_features, entries, recipe)
    return one_of(of_features, recipe, np.concatenate([test.truth_m for test in tests]))


def ours_split(recipe, dataset, splits):
    """Estimates for the test images of every split: pairs of what is learned from and what is tested."""
    with tempfile.TemporaryDirectory(dir=WORK) as folder:
        folder = Path(folder)
        omniloc("import", dataset.folder, "--out", folder / "all.mcap")
        names = []
        for number, (learning, test) in enumerate(splits):
            # The last two are those that features are chosen on; the default recipe then learns from them too.
            sets = {**dict.fromkeys(learning[:-2], "learning"), **dict.fromkeys(learning[-2:], "validation"),
                    **dict.fromkeys(test, "test")}
            names.append(folder / f"{number}.csv")
            rows = "".join(f"{dataset.rows[i]['index']},{kind}\n" for i, kind in sets.items())
            names[-1].write_text(f"index,set\n{rows}")
        select = ["--select", "none"] if recipe == "paper" else []
        omniloc("evaluate", folder / "all.mcap", "--recipe", recipe, *select, "--variants", "plain", "--split",
                ",".join(map(str, names)), "--json", folder / "all.json", "--frames")
        entries = json.loads((folder / "all.json").read_text())["results"]
    of_features = {}
    collect(of_features, entries, recipe)
    return one_of(of_features, recipe, np.concatenate([dataset.truth_m[test] for _, test in splits]))


def collect(of_features, entries, recipe):
    """Adds the single-frame estimates of every row of the recipe to those of its features."""
    for entry in entries:
        if entry["recipe"] == recipe and entry["estimator"] == "single":
            of_features.setdefault(entry["features"], []).append(estimates_of(entry))


def one_of(of_features, recipe, truth_m):
    """What the recipe stands for: all its features fused. The paper leaves open which to take: here its best row by
    hindsight."""
    found = {features: np.concatenate(parts) for features, parts in of_features.items()}
    if recipe == "default":
        return found["fused"] if "fused" in found else next(iter(found.values()))
    return min(found.values(), key=lambda estimates_m: np.square(estimates_m - truth_m).sum())
