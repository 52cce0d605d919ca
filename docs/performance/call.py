#!/usr/bin/env python3
"""Counts what a call takes of the processor: prints a table of docs/PERFORMANCE.md.

    python3 docs/performance/call.py             # cargo and valgrind are needed

Each way of the benchmark runs under callgrind, whose scheduler gives client and server fair turns: each
wake-up then finds the replies of all links. Instructions are the difference between 6000 and 2000 calls
over one link, and between 76,800 and 25,600 over 64 links, of the client's thread, without the kernel.
Code is the number of lines of 64 bytes that nearly every call runs. Memory is the number of such lines
that a call finds in no cache of 1 MiB, with 1000 links in turn.
"""

import collections
import json
import re
import subprocess
import tempfile
from pathlib import Path

WAYS = {
    "bare-binary": "bare write and read",
    "tokio-modbus": "tokio-modbus",
    "modbus-timed": "tokio-modbus, in a timeout",
    "into-binary": "`read_registers_into`, binary",
    "single-binary": "the same, `copies=0`",
    "fatek-binary": "`read_registers`, binary",
    "fatek-ascii": "`read_registers`, ASCII",
}
# Rounds of the benchmark: two to warm up and two to measure.
ROUNDS = 4


def main():
    program = build()
    print("| | instructions, 1 link | 64 links | code | memory |\n|---|---|---|---|---|")
    for way, name in WAYS.items():
        one = instructions(program, way, 1, (500, 1500))
        of_64 = instructions(program, way, 64, (100, 300))
        code = lines_of_code(count(program, way, "64,1", 100, "--dump-instr=yes"), 64 * 100 * ROUNDS)
        few, many = (misses(count(program, way, "1000,1", calls, *CACHES)) for calls in (3, 9))
        memory = (many - few) / (6 * 1000 * ROUNDS)
        counts = f"{round(one, -1):,.0f} | {round(of_64, -1):,.0f}"
        print(f"| {name} | {counts} | {code * 64 / 1024:.0f} KiB | {memory:.0f} lines |", flush=True)


def instructions(program, way, links, calls):
    few, many = (total(count(program, way, f"{links},1", each), "Ir") for each in calls)
    return (many - few) / ((calls[1] - calls[0]) * links * ROUNDS)


def build():
    bench = ["cargo", "bench", "-p", "fatek-benches", "--bench", "call", "--no-run", "--message-format=json"]
    built = subprocess.run(bench, check=True, text=True, stdout=subprocess.PIPE).stdout
    messages = [json.loads(line) for line in built.splitlines() if line.startswith("{")]
    return [m["executable"] for m in messages if m.get("executable") and m["target"]["name"] == "call"][-1]


CACHES = ["--cache-sim=yes", "--LL=1048576,16,64"]


def count(program, way, setting, requests, *options):
    """The lines of callgrind's output for the client's thread, which is the first one."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        valgrind = ["valgrind", "--tool=callgrind", "--separate-threads=yes", "--fair-sched=yes"]
        what = ["--rounds", "2", "--requests", str(requests), "--way", way, "--setting", setting]
        valgrind += [f"--callgrind-out-file={out}", *options]
        subprocess.run([*valgrind, program, *what, "--runtime", "current_thread"], check=True, capture_output=True)
        return Path(f"{out}-01").read_text().splitlines()


def total(lines, event):
    events = next(line for line in lines if line.startswith("events:")).split()[1:]
    totals = next(line for line in lines if line.startswith("totals:")).split()[1:]
    return dict(zip(events, map(int, totals)))[event]


def misses(lines):
    return total(lines, "DLmr") + total(lines, "DLmw")


def lines_of_code(lines, calls):
    """How many lines of 64 bytes are run by at least every second call."""
    runs, address, called = collections.Counter(), 0, False
    for line in lines:
        if line.startswith("calls="):
            called = True
            continue
        cost = re.match(r"(0x[0-9a-f]+|[+-]\d+|\*) \S+ (\d+)$", line)
        if not cost:
            continue
        place, times = cost.groups()
        if place.startswith("0x"):
            address = int(place, 16)
        elif place != "*":
            address += int(place)
        # A called function is counted there.
        if not called:
            runs[address // 64] += int(times)
        called = False
    return sum(times >= calls / 2 for times in runs.values())


if __name__ == "__main__":
    main()
