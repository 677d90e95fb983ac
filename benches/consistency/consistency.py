#!/usr/bin/env python3
"""Is the stated covariance right on the whole, over receivers that err differently from survey to survey?

    python3 benches/consistency/consistency.py [--places 11,12] [--surveys 6] [--folder FOLDER]

Simulates towns on two days, gives the survey's exact positions the errors of a receiver, each time others (0.6 m an axis,
alike for 20 or 60 s, in turn), trains a map on each and localizes the other day on it. Prints a line a survey, and the mean
NEES (2 is exact) and coverage of the 95 % region over all: one survey alone says little, as its receiver's mean error
over a drive of minutes is one draw. Only Python's standard library; OMNILOC names the program.
"""

import argparse
import csv
import json
import math
import os
import random
import shutil
import statistics
import subprocess
from pathlib import Path

PROGRAM = os.environ.get("OMNILOC", "target/release/omniloc")
RECEIVER_STD_M = 0.6
RECEIVER_TIMES_S = (20.0, 60.0)
FRAMES = "378"


def omniloc(*arguments):
    subprocess.run([PROGRAM, *map(str, arguments)], check=True, capture_output=True)


def simulated(folder, place, day, lane_shift_m):
    """The data set of a town on a day, made if it is not there, and its recording."""
    dataset = folder / f"town-{place}-day-{day}"
    recording = dataset.with_suffix(".mcap")
    if not recording.exists():
        omniloc("simulate", "--world", "town", "--seed", place, "--day", day, "--lane-shift-m", lane_shift_m,
                "--frames", FRAMES, "--out", dataset, "--force")
        omniloc("import", dataset, "--out", recording)
    return dataset, recording


def receiver_errors(times_s, correlation_s, seed):
    """A first-order Gauss-Markov process on either axis."""
    draw = random.Random(seed)
    errors, before_s = [], None
    for time_s in times_s:
        kept = 0.0 if before_s is None else math.exp(-(time_s - before_s) / correlation_s)
        last = errors[-1] if errors else (0.0, 0.0)
        fresh = RECEIVER_STD_M * math.sqrt(1.0 - kept * kept)
        errors.append(tuple(kept * error + fresh * draw.gauss(0.0, 1.0) for error in last))
        before_s = time_s
    return errors


def survey(folder, dataset, seed):
    """A recording of `dataset` with positions that err."""
    out = folder / f"{dataset.name}-survey-{seed}"
    out.mkdir(exist_ok=True)
    shutil.copy(dataset / "donut.json", out)
    if not (out / "images").exists():
        (out / "images").symlink_to((dataset / "images").resolve())
    rows = list(csv.DictReader((dataset / "positions.csv").open()))
    truth = list(csv.DictReader((dataset / "truth.csv").open()))
    correlation_s = RECEIVER_TIMES_S[seed % len(RECEIVER_TIMES_S)]
    errors = receiver_errors([float(row["time_s"]) for row in rows], correlation_s, f"{dataset.name} {seed}")
    with (out / "positions.csv").open("w") as file:
        file.write("index,file,x_m,y_m,yaw_rad,time_s\n")
        for row, exact, (east_m, north_m) in zip(rows, truth, errors):
            x_m, y_m = float(exact["x_m"]) + east_m, float(exact["y_m"]) + north_m
            file.write(f"{row['index']},{row['file']},{x_m:.4f},{y_m:.4f},{row['yaw_rad']},{row['time_s']}\n")
    recording = out.with_suffix(".mcap")
    omniloc("import", out, "--out", recording, "--force")
    return recording


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", default="11,12", help="seeds of the towns")
    parser.add_argument("--surveys", type=int, default=6, help="surveys of each")
    parser.add_argument("--folder", type=Path, default=Path("target/consistency"))
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    found = []
    print("place survey   RMSE  median    P95    NEES  in 95 %  localized")
    for place in options.places.split(","):
        surveyed, _ = simulated(options.folder, place, 1, 0.0)
        other_day, other_recording = simulated(options.folder, place, 2, 0.4)
        for seed in range(1, options.surveys + 1):
            area, results = options.folder / "area.map", options.folder / "results.json"
            omniloc("train", survey(options.folder, surveyed, seed), "--out", area, "--force")
            omniloc("evaluate", other_recording, "--map", area, "--truth", other_day / "truth.csv",
                    "--json", results, "--force")
            entries = json.loads(results.read_text())["results"]
            of = next(entry for entry in entries if entry["estimator"] == "filtered")
            found.append(of)
            print(f"{place:>5} {seed:6} {of['rmse_m']:6.2f} {of['median_m']:7.2f} {of['p95_m']:6.2f} {of['nees_mean']:7.2f}"
                  f" {100 * of['coverage_95']:8.1f} {100 * of['localized_share']:10.1f}", flush=True)
    mean = {key: statistics.mean(of[key] for of in found) for key in ("nees_mean", "coverage_95")}
    print(f"mean of {len(found)}: NEES {mean['nees_mean']:.2f}, in the region of 95 % {100 * mean['coverage_95']:.1f} %")


if __name__ == "__main__":
    main()
