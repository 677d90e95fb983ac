"""Kidnaps: a drive is cut and joined so that the vehicle jumps, and localized on a map.

    python3 benches/kidnap/kidnap.py AREA.map DATASET [--count 30] [--least-m 40] [--truth CSV] [--config FILE]

DATASET is a folder that `omniloc import` reads, of another day than the map's. Needs nothing but the program
(target/release/omniloc, or OMNILOC). Prints, for every kidnap, after how many frames it was noticed, after how many the position was
known again, and how many positions in between were off by more than 10 m.
"""

import argparse
import csv
import json
import math
import os
import random
import shutil
import subprocess
import tempfile
from pathlib import Path

PROGRAM = Path(os.environ.get("OMNILOC", Path(__file__).resolve().parents[2] / "target/release/omniloc"))
BEFORE, AFTER = 20, 30
WRONG_M = 10.0


def localize(folder, frames, source, rows, area, origin, config):
    """States and positions of the frames `frames` of `rows`, one second apart, as a drive of its own."""
    dataset = folder / "dataset"
    shutil.rmtree(dataset, ignore_errors=True)
    (dataset / "images").mkdir(parents=True)
    for name in ("donut.json", "recording.json"):
        if (source / name).exists():
            shutil.copy(source / name, dataset)
    with open(dataset / "positions.csv", "w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["index", "file", "x_m", "y_m", "yaw_rad", "time_s"])
        start_s = 0.0
        for number, frame in enumerate(frames):
            row = rows[frame]
            os.symlink(source / "images" / Path(row["file"]).name, dataset / "images" / f"{number:05}.jpg")
            if number:
                previous = rows[frames[number - 1]]
                gap_s = float(row["time_s"]) - float(previous["time_s"])
                start_s += gap_s if frame == frames[number - 1] + 1 else 1.0
            out.writerow([number, f"{number:05}.jpg", row["x_m"], row["y_m"], row["yaw_rad"], f"{start_s:.4f}"])
    recording = folder / "drive.mcap"
    subprocess.run([PROGRAM, "import", dataset, "--out", recording, "--force", *origin], check=True, capture_output=True)
    command = [PROGRAM, "replay", recording, "--mode", "localize", "--map", area, *config]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [json.loads(line) for line in lines]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("area", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--least-m", type=float, default=40.0)
    parser.add_argument("--truth", type=Path, help="CSV index,x_m,y_m: where the vehicle really was")
    parser.add_argument("--origin", help="as for `omniloc import`")
    parser.add_argument("--config", help="as for `omniloc replay`: `[map] memory_mib = 0` to have the map read as it is needed")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    source = args.dataset.resolve()
    rows = list(csv.DictReader(open(source / "positions.csv")))
    truth = {int(row["index"]): row for row in csv.DictReader(open(args.truth))} if args.truth else None
    place = lambda row: (float(row["x_m"]), float(row["y_m"]))
    places = [place(truth[int(row["index"])] if truth else row) for row in rows]
    origin = ["--origin", args.origin] if args.origin else []
    config = ["--config", args.config] if args.config else []
    chance = random.Random(args.seed)
    noticed, known, wrong = [], [], 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        while len(noticed) < args.count:
            i = chance.randrange(BEFORE, len(rows) - 1)
            j = chance.randrange(0, len(rows) - AFTER)
            if math.dist(places[i], places[j]) < args.least_m:
                continue
            frames = list(range(i - BEFORE, i)) + list(range(j, j + AFTER))
            found = localize(folder, frames, source, rows, args.area, origin, config)
            after = found[BEFORE:]
            silent = next((k for k, line in enumerate(after) if line["state"] != "localized"), None)
            error = lambda k: math.dist((after[k]["e_m"], after[k]["n_m"]), places[j + k])
            said = [k for k, line in enumerate(after) if line["state"] == "localized"]
            wrong_now = sum(error(k) > WRONG_M for k in said)
            again = next((k for k in said if silent is not None and k > silent and error(k) <= WRONG_M), None)
            was = found[BEFORE - 1]["state"]
            print(f"{math.dist(places[i], places[j]):5.0f} m: {was} before, noticed after {silent}, known again after {again}, "
                  f"{wrong_now} wrong", flush=True)
            noticed.append(silent)
            known.append(again)
            wrong += wrong_now
    worst = lambda values: "never" if None in values else max(values)
    print(f"{len(noticed)} kidnaps: noticed after at most {worst(noticed)} frames, known again after at most {worst(known)}, "
          f"{wrong} wrong positions")


if __name__ == "__main__":
    main()
