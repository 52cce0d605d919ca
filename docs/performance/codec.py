#!/usr/bin/env python3
"""Measures the codecs: writes codec.csv beside this file, and prints the tables of docs/PERFORMANCE.md.

    python3 docs/performance/codec.py            # cargo and valgrind are needed
    python3 docs/performance/codec.py --tables   # the tables of the codec.csv that is there

Times are medians of the quickest of five runs, because the machine may be shared. Instructions are the
difference between 3000 and 1000 repetitions under callgrind, so that they are those of the work alone.
"""

import csv
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
FILE = HERE / "codec.csv"
RUNS = 5
FRAMES = {
    "64-registers-request": "64 registers, request",
    "64-registers-reply": "64 registers, reply",
    "256-discretes-request": "256 discretes, request",
    "256-discretes-reply": "256 discretes, reply",
}


def main():
    if "--tables" not in sys.argv[1:]:
        rows = measure()
        with FILE.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    tables(load())


def load():
    """The rows of the file, by framing, frame and job."""
    with FILE.open(newline="") as file:
        return {
            (row["framing"], row["frame"], row["job"]): {
                "bytes": int(row["bytes"]),
                "ns": float(row["ns"]),
                "instructions": int(row["instructions"]),
            }
            for row in csv.DictReader(file)
        }


def limit_of(framing, frame, job):
    """The least that could do what this job does."""
    values = job == "client" and frame.endswith("reply")
    return (framing, frame, "limit-of-values" if values else "limit")


def measure():
    bench = ["cargo", "bench", "-p", "fatek-benches", "--bench", "codec"]
    built = run([*bench, "--no-run", "--message-format=json"]).stdout
    messages = [json.loads(line) for line in built.splitlines() if line.startswith("{")]
    program = [m["executable"] for m in messages if m.get("executable") and m["target"]["name"] == "codec"][-1]
    runs = [medians(program) for _ in range(RUNS)]
    return [
        {
            "framing": framing,
            "frame": frame,
            "job": job,
            "bytes": size,
            "ns": round(min(medians[framing, frame, job, size] for medians in runs), 1),
            "instructions": instructions(program, f"{framing}/{frame}/{job}"),
        }
        for framing, frame, job, size in sorted(runs[0])
    ]


def medians(program):
    """One run of the benchmark: nanoseconds by framing, frame, job and length in bytes."""
    times = {}
    with tempfile.TemporaryDirectory() as results:
        run([program, "--bench"], CRITERION_HOME=results)
        for file in Path(results).glob("**/new/benchmark.json"):
            about = json.loads(file.read_text())
            median = json.loads((file.parent / "estimates.json").read_text())["median"]
            key = (*about["group_id"].split("/"), about["function_id"], about["throughput"]["Bytes"])
            times[key] = median["point_estimate"]
    return times


def instructions(program, case):
    """How many instructions one repetition takes."""
    few, many = 1000, 3000
    return round((collected(program, case, many) - collected(program, case, few)) / (many - few))


def collected(program, case, times):
    valgrind = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", program]
    done = run(valgrind, FATEK_CODEC_CASE=case, FATEK_CODEC_TIMES=str(times))
    return int(re.search(r"Collected : (\d+)", done.stderr)[1])


def run(command, **environment):
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr}")
    return done


def tables(rows):
    for framing in ["ascii", "binary"]:
        print(f"\n| {framing} | bytes | | ns | limit | ratio | MB/s | instructions | limit | ratio |")
        print("|---|---|---|---|---|---|---|---|---|---|")
        for frame, name in FRAMES.items():
            for job in ["encode", "decode", "client"]:
                it, limit = rows[framing, frame, job], rows[limit_of(framing, frame, job)]
                print(
                    f"| {name} | {it['bytes']} | {job} | {it['ns']:.0f} | {limit['ns']:.0f} "
                    f"| {it['ns'] / limit['ns']:.1f} | {1000 * it['bytes'] / it['ns']:.0f} | {it['instructions']} "
                    f"| {limit['instructions']} | {it['instructions'] / limit['instructions']:.1f} |"
                )


if __name__ == "__main__":
    main()
