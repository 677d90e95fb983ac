"""Runs the comparison and writes the report. Run by `days`."""

import argparse
import json
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np

import retrieval
from places import DAYS, OMNILOC, RECIPES, WORK, Dataset, Failed, ours, ours_split, program, simulated

PLACES = [*(f"town-{seed}" for seed in range(108, 115)), *(f"corridor-{seed}" for seed in range(101, 104)),
          "hall-101", "hall-102"]
QUICK = ["town-108", "corridor-101"]
# What settings are chosen on: never reported.
TUNING = ["town-11", "town-12", "corridor-11", "hall-11"]
METHODS = ("default", *retrieval.PEERS, "paper")
NAMES = {"default": "omniloc", "paper": "paper's recipe", "aligned": "aligned retrieval", "sift-vlad": "SIFT-VLAD"}
STEPS = (1, 2, 4, 8)
SPLITS = 5
begin_s = time.monotonic()


def say(text):
    print(f"{time.monotonic() - begin_s:6.0f} s  {text}", file=sys.stderr, flush=True)


def kept(name, stamp, compute):
    """What was computed before under this name and stamp, or what `compute` gives now."""
    path = WORK / "results" / f"{name}.json"
    if path.exists():
        found = json.loads(path.read_text())
        if found["stamp"] == stamp:
            return np.array(found["estimates_m"])
    estimates_m = compute()
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(f".{os.getpid()}")
    unfinished.write_text(json.dumps({"stamp": stamp, "estimates_m": np.round(estimates_m, 4).tolist()}))
    unfinished.rename(path)
    return estimates_m


def measure(name, described, learning, tests, methods):
    """Errors of every method for the frames of all `tests`, with a map of `learning`; `described`: which sets these are."""
    errors_m = {}
    truth_m = np.concatenate([test.truth_m for test in tests])
    queries = [image for test in tests for image in test.images]
    for method in methods:
        def found():
            if method in RECIPES:
                return ours(method, learning, tests)
            lens, only = retrieval.Lens.of(learning.folder), {method: retrieval.PEERS[method]}
            return retrieval.estimates(only, lens, learning.images, learning.positions_m, queries)[method]

        version = program() if method in RECIPES else retrieval.PEERS[method].settings
        estimates_m = kept(f"{name}-{method}", [described, version], found)
        errors_m[method] = np.linalg.norm(estimates_m - truth_m, axis=1)
        say(f"{name}: {NAMES[method]} {summary(errors_m[method])}")
    return errors_m


def figures(errors_m):
    return {"rmse_m": float(np.sqrt(np.mean(np.square(errors_m)))), "median_m": float(np.median(errors_m)),
            "p95_m": float(np.percentile(errors_m, 95)), "share_over_10m": float(np.mean(errors_m > 10)),
            "frames": len(errors_m)}


def summary(errors_m):
    of = figures(errors_m)
    return f"RMSE {of['rmse_m']:.2f} m, median {of['median_m']:.2f}, P95 {of['p95_m']:.2f}, over 10 m {of['share_over_10m']:.1%}"


def result(label, errors_m, days=None):
    """One row of the report; `days`: how many frames every day has."""
    row = {"place": label, "methods": {method: figures(errors) for method, errors in errors_m.items()}}
    row["best"] = min(row["methods"], key=lambda method: row["methods"][method]["rmse_m"])
    if days:
        ends = np.cumsum([count for _, count in days])[:-1]
        parts = {method: np.split(errors, ends) for method, errors in errors_m.items()}
        row["days"] = {day: {method: figures(parts[method][i]) for method in parts} for i, (day, _) in enumerate(days)}
    return row


def one_place(job):
    place, days, frames, methods = job
    cv2.setNumThreads(1)
    say(f"{place}: the place on {1 + len(days)} days")
    learning_frames, test_frames = counts(place, frames)
    learning = simulated(place, 1, learning_frames)
    tests = [simulated(place, day, test_frames) for day in days]
    label = f"{place}-days-{'-'.join(map(str, days))}-of-{frames}"
    errors_m = measure(label, [label, str(DAYS)], learning, tests, methods)
    return result(place, errors_m, [(day, len(test.images)) for day, test in zip(days, tests)])


def counts(place, frames):
    """Images to learn from and of every other day. A corridor needs fewer; how many a hall has follows from its lattice."""
    return (frames if place.startswith("town") else frames // 2), 3 * frames // 8


def thinned(job):
    """The same place with every image, every 2nd, 4th, 8th to learn from."""
    name, learning, tests, step, methods = job
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory(dir=WORK) as folder:
        part = learning.part(range(0, len(learning.images), step), Path(folder) / "thin")
        spacing_m = np.median(np.linalg.norm(np.diff(part.positions_m, axis=0), axis=1))
        described = [name, step, len(part.images), [len(test.images) for test in tests]]
        errors_m = measure(f"thin-{name}-{step}", described, part, tests, methods)
    return {**result(f"{name}, every {step}", errors_m), "step": step, "spacing_m": float(spacing_m)}


def thin_jobs(frames, data, methods):
    jobs = []
    if data:
        jobs += [("drive-378", Dataset(data / "drive-378"), [Dataset(data / "drive-378-day2")], step, methods) for step in STEPS]
    for place in ("town-101", "town-102"):
        learning_frames, test_frames = counts(place, frames)
        learning, tests = simulated(place, 1, learning_frames), [simulated(place, day, test_frames) for day in (2, 3)]
        jobs += [(place, learning, tests, step, methods) for step in STEPS]
    return jobs


def splits_of(dataset, splits, methods):
    """Test errors of every method over splits: pairs of images learned from and images tested."""
    lens = retrieval.Lens.of(dataset.folder)
    panoramas = [lens.panorama(image) for image in dataset.images]
    truth_m = np.concatenate([dataset.truth_m[test] for _, test in splits])
    errors_m = {}
    for name in methods:
        if name in RECIPES:
            errors_m[name] = np.linalg.norm(ours_split(name, dataset, splits) - truth_m, axis=1)
            continue
        peer = retrieval.PEERS[name]
        described = [peer.describe(panorama) for panorama in panoramas]
        found = []
        for learning, test in splits:
            peer.learn([described[i] for i in learning])
            found += [dataset.positions_m[learning[peer.nearest(described[i])]] for i in test]
        errors_m[name] = np.linalg.norm(np.array(found) - truth_m, axis=1)
    guesses = [np.median(dataset.positions_m[learning], 0) for learning, test in splits for _ in test]
    errors_m["median"] = np.linalg.norm(np.array(guesses) - truth_m, axis=1)
    return errors_m


def courtyard(data, methods):
    dataset = Dataset(data / "courtyard-75")
    n = len(dataset.images)
    everyone = [([i for i in range(n) if i != left_out], [left_out]) for left_out in range(n)]
    random = np.random.default_rng(0)
    orders = [random.permutation(n) for _ in range(SPLITS)]
    halves = [(sorted(order[:3 * n // 4].tolist()), sorted(order[3 * n // 4:].tolist())) for order in orders]
    say("courtyard-75: leave one out")
    rows = [result("leave one out", splits_of(dataset, everyone, methods))]
    say("courtyard-75: splits")
    return rows + [result(f"a quarter left out, {SPLITS} splits", splits_of(dataset, halves, methods))]


def tune(frames):
    """The peers' candidates on places that are not reported."""
    totals = {}
    for place in TUNING:
        learning_frames, test_frames = counts(place, frames)
        learning, tests = simulated(place, 1, learning_frames), [simulated(place, day, test_frames) for day in (2, 3)]
        queries = [image for test in tests for image in test.images]
        truth_m = np.concatenate([test.truth_m for test in tests])
        lens = retrieval.Lens.of(learning.folder)
        found = retrieval.estimates(retrieval.CANDIDATES, lens, learning.images, learning.positions_m, queries)
        for name, estimates_m in found.items():
            errors_m = np.linalg.norm(estimates_m - truth_m, axis=1)
            print(f"{place:14} {name:48} {summary(errors_m)}", flush=True)
            totals.setdefault(name, []).append(np.log(figures(errors_m)["rmse_m"]))
    print("\nGeometric mean of the RMSE over the places")
    for name, logarithms in sorted(totals.items(), key=lambda item: np.mean(item[1])):
        print(f"{name:48} {np.exp(np.mean(logarithms)):.2f} m")


def table(title, rows):
    """Markdown: RMSE (median; P95; share over 10 m) of every method, the least RMSE in bold."""
    methods = list(rows[0]["methods"])
    names = [NAMES.get(method, "always the median") for method in methods]
    lines = [f"## {title}", "", f"| place | {' | '.join(names)} |", f"|---|{'---|' * len(methods)}"]
    for row in rows:
        cells = []
        for method in methods:
            of = row["methods"][method]
            rmse = f"{of['rmse_m']:.2f}"
            rmse = f"**{rmse}**" if method == row["best"] else rmse
            cells.append(f"{rmse} ({of['median_m']:.2f}; {of['p95_m']:.2f}; {of['share_over_10m']:.1%})")
        spacing = f" ({row['spacing_m']:.1f} m apart)" if "spacing_m" in row else ""
        lines.append(f"| {row['place']}{spacing} | {' | '.join(cells)} |")
    wins = sum(row["best"] == "default" for row in rows)
    return "\n".join([*lines, "", f"omniloc has the least RMSE in {wins} of {len(rows)} rows.", ""])


def arguments():
    parser = argparse.ArgumentParser(prog="benches/peers/days")
    parser.add_argument("--places", help="separated by commas: town-101, corridor-3, hall-1, ...")
    parser.add_argument("--days", default="2,3,4,5", help="days to measure, of 2 to 5")
    parser.add_argument("--frames", type=int, default=400, help="learning images of a town; everything else follows")
    parser.add_argument("--methods", default=",".join(METHODS), help="default, paper, aligned, sift-vlad")
    parser.add_argument("--jobs", type=int, default=2, help="places at a time")
    for mode, what in (("quick", "two places, two days"), ("thin", "fewer and fewer learning images"),
                       ("courtyard", "real photographs"), ("tune", "settings of the peers")):
        parser.add_argument(f"--{mode}", action="store_true", help=what)
    return parser.parse_args()


def main():
    args = arguments()
    cv2.setNumThreads(1)
    WORK.mkdir(parents=True, exist_ok=True)
    methods = args.methods.split(",")
    data = Path(os.environ["OMNILOC_DATA"]) if "OMNILOC_DATA" in os.environ else None
    if args.tune:
        return tune(args.frames)
    name = "thin" if args.thin else "courtyard" if args.courtyard else "quick" if args.quick else "days"
    with ProcessPoolExecutor(args.jobs) as pool:
        if args.courtyard:
            if not data:
                sys.exit("--courtyard needs OMNILOC_DATA=DIR with DIR/courtyard-75")
            title = "courtyard-75, photographs about 10 m apart, positions of a telephone"
            rows = courtyard(data, methods)
        elif args.thin:
            title, rows = "Fewer learning images", list(pool.map(thinned, thin_jobs(args.frames, data, methods)))
        else:
            places = args.places.split(",") if args.places else QUICK if args.quick else PLACES
            days = [2, 3] if args.quick else [int(day) for day in args.days.split(",")]
            frames = 240 if args.quick else args.frames
            title = f"Another day: day 1 learned, days {', '.join(map(str, days))} measured"
            rows = list(pool.map(one_place, [(place, days, frames, methods) for place in places]))
    report = table(title, rows)
    report += f"\nRMSE (median; 95th percentile; share over 10 m), metres, single frames. {OMNILOC}, {program()}.\n"
    (WORK / f"{name}.md").write_text(report)
    (WORK / f"{name}.json").write_text(json.dumps({"title": title, "program": program(), "rows": rows}, indent=1))
    print(report)


if __name__ == "__main__":
    try:
        main()
    except (Failed, OSError, ValueError) as error:
        sys.exit(f"error: {error}")
