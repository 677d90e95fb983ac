"""Instructions a frame, stage by stage, of a replay that count.c has counted.

    python3 stages.py PROGRAM COUNTS FRAMES

PROGRAM has its symbols. An instruction counts for the function that it lies in, so what was inlined counts for the caller
and a stage is whose code it mostly is. What runs once, reading the map above all, is left out.
"""

import bisect
import collections
import re
import subprocess
import sys

# The first that matches counts.
STAGES = [
    ("once", r"omniloc::(map|commands|config)|clap|toml|serde|safetensors|sha2|crc32|json|std::fs|tracing_subscriber"),
    ("decode", r"omniloc::jpeg|zune"),
    ("lens", r"omniloc::(runtime::localize::lens_check|calibrate)"),
    ("unwrap", r"omniloc::panorama"),
    ("describe", r"omniloc::features|rustfft|realfft|libm::math::logf"),
    ("match", r"omniloc::localize::(likelihood|cells|large)"),
    ("track", r"omniloc::localize|libm"),
    ("recording", r"omniloc::recording|mcap|prost"),
    ("outputs", r"omniloc::outputs"),
]


def symbols(program):
    """Addresses and names of the program's functions, by address."""
    lines = subprocess.run(["nm", "-C", "--defined-only", program], check=True, capture_output=True, text=True).stdout
    found = []
    for line in lines.splitlines():
        address, kind, name = line.split(" ", 2)
        # ARM marks kinds of code with $a, $d, $t, $x.
        if kind in "tTwW" and not name.startswith("$"):
            found.append((int(address, 16), name))
    if not found:
        sys.exit(f"{program} has no symbols: build it as benches/instructions/run does")
    return sorted(found)


def start_of_code(program):
    """Address of the executable segment in the file."""
    segments = subprocess.run(["readelf", "-lW", program], check=True, capture_output=True, text=True).stdout
    return int(re.search(r"^\s+LOAD\s+\S+\s+(0x[0-9a-f]+).*R E", segments, re.MULTILINE)[1], 16)


def main():
    program, counts, frames = sys.argv[1], sys.argv[2], int(sys.argv[3])
    found = symbols(program)
    addresses = [address for address, _ in found]
    end = addresses[-1] + 0x10000
    stages, functions = collections.Counter(), collections.Counter()
    with open(counts) as lines:
        shift = int(next(lines), 16) - start_of_code(program)
        for line in lines:
            address, count = line.split()
            address = int(address, 16) - shift
            inside = addresses[0] <= address < end
            name = found[bisect.bisect(addresses, address) - 1][1] if inside else "the system's libraries"
            stage = next((stage for stage, pattern in STAGES if re.search(pattern, name)), "other")
            stages[stage] += int(count)
            functions[stage, name] += int(count)
    print(f"{'stage':10} {'million instructions a frame':>30}")
    for stage in ["decode", "lens", "unwrap", "describe", "match", "track", "outputs", "recording", "other"]:
        print(f"{stage:10} {stages[stage] / frames / 1e6:30.3f}")
    print(f"{'frame':10} {(stages.total() - stages['once']) / frames / 1e6:30.3f}")
    print(f"once: {stages['once'] / 1e6:.0f} million")
    print("\nmost of it:")
    for (stage, name), count in functions.most_common(25):
        print(f"{count / frames / 1e6:9.3f} {stage:10} {name[:110]}")


main()
