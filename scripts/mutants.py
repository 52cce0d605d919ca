#!/usr/bin/env python3
"""Runs all mutants of `cargo mutants --list` from one build.

cargo-mutants builds the crate once per mutant, which takes hours. This script writes every mutant of a
function into that function as a branch selected by the environment variable MUTANT. It builds once, and records the
functions that each test reaches. For each mutant it runs the tests of its function, fastest first, until one fails.

    scripts/mutants.py build                copy the sources, write the branches, build, trace the tests
    scripts/mutants.py run [-f GLOB]...     run the tests for each mutant without a result; --budget SECONDS per mutant
    scripts/mutants.py report [-f GLOB]...  print the results by file, and the missed mutants

Mutants outside of functions, and mutants that compile only alone, are left to `cargo mutants --re NAME`. All files are
written to the directory MUTANTS_DIR (default: target/mutants-in-one-build).
"""

import argparse
import collections
import concurrent.futures
import fnmatch
import json
import math
import os
import pathlib
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = pathlib.Path(os.environ.get("MUTANTS_DIR", ROOT / "target/mutants-in-one-build"))
TREE = OUT / "tree"
GLOBS = ["src/hex.rs", "src/wire/**", "src/command/**", "src/link/**", "src/transport/**"]
FEATURES = ["--features", "serial,sim"]
# Tests that need the command line or another program, take minutes, or reach these folders only by paths of other
# tests.
SKIPPED_TESTS = re.compile(r"^(cli.*|gateway|in_step|plan|program|backup|peers|saved_files)$")
# Tests in real time: a failure counts only if it is repeated.
WALL_CLOCK = {"tcp", "udp", "serial", "pool", "campaign"}
SWITCH = """//! The active mutant.
use std::io::Write as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::OnceLock;

static SEEN: [AtomicBool; 4096] = [const { AtomicBool::new(false) }; 4096];

pub(crate) fn on(function: usize) -> u32 {
    static MUTANT: OnceLock<u32> = OnceLock::new();
    static TRACE: OnceLock<Option<std::path::PathBuf>> = OnceLock::new();
    if let Some(path) = TRACE.get_or_init(|| std::env::var_os("MUTANT_TRACE").map(Into::into))
        && !SEEN[function].swap(true, Ordering::Relaxed)
    {
        let mut file = std::fs::OpenOptions::new().create(true).append(true).open(path).unwrap();
        file.write_all(format!("{function}\\n").as_bytes()).unwrap();
    }
    *MUTANT.get_or_init(|| std::env::var("MUTANT").ok().and_then(|text| text.parse().ok()).unwrap_or(0))
}
"""


def listed():
    """Returns the mutants of cargo-mutants, with its settings."""
    command = ["cargo", "mutants", "--list", "--json", *FEATURES]
    for glob in GLOBS:
        command += ["-f", glob]
    mutants = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True).stdout)
    for number, mutant in enumerate(mutants, 1):
        mutant["number"] = number
    return mutants


def is_left_out(mutant):
    """Returns whether the mutant is left to cargo-mutants: outside of functions, in a constant one, or with branches of
    several types."""
    if not mutant.get("function") or "-> impl " in mutant["function"]["return_type"]:
        return True
    source = Text(ROOT / mutant["file"])
    start, end = source.span(mutant["function"]["span"])
    return bool(re.search(r"\bconst\s+fn\s", source.text[start:end].split("{", 1)[0]))


class Text:
    """Source file with access by line and column."""

    def __init__(self, path):
        self.text = path.read_text()
        self.starts = [0]
        for line in self.text.split("\n"):
            self.starts.append(self.starts[-1] + len(line) + 1)

    def offset(self, place):
        return self.starts[place["line"] - 1] + place["column"] - 1

    def span(self, span):
        return self.offset(span["start"]), self.offset(span["end"])


def body_of(text, start, end):
    """Returns the offsets of the braces of the function from start to end."""
    at = start
    match = re.compile(r"\bfn\s+\w+").search(text, start, end)
    at = match.end()
    depth = 0
    while at < end:
        if text[at] in "([":
            depth += 1
        elif text[at] in ")]":
            depth -= 1
        elif text[at] == "{" and depth == 0:
            return at, end - 1
        at += 1
    raise ValueError("function without a body")


def branches(path, mutants, functions):
    """Returns the file with a branch for each mutant, and the lines of each branch."""
    source = Text(path)
    by_function = collections.defaultdict(list)
    for mutant in mutants:
        by_function[source.span(mutant["function"]["span"])].append(mutant)
    # Nested functions belong to the outer one.
    outer = {}
    for span in sorted(by_function, key=lambda s: (s[0], -s[1])):
        home = next((o for o in outer if o[0] <= span[0] and span[1] <= o[1]), span)
        outer.setdefault(home, []).extend(by_function[span])
    out, at = [], 0
    for (start, end), inside in sorted(outer.items()):
        opening, closing = body_of(source.text, start, end)
        body = source.text[opening + 1 : closing]
        function = len(functions)
        functions.append([m["number"] for m in inside])
        out.append(source.text[at : opening + 1])
        out.append(f"\nmatch crate::mutant_switch::on({function}) {{\n")
        for mutant in inside:
            first, last = source.span(mutant["span"])
            first, last = first - opening - 1, last - opening - 1
            changed = body[:first] + " " + mutant["replacement"] + " " + body[last:]
            out.append((mutant["number"], f"{mutant['number']} => {{\n{changed}\n}}\n"))
        out.append(f"_ => {{{body}}}\n}}\n")
        at = closing
    out.append(source.text[at:])
    lines, text = {}, ""
    line = 1
    for piece in out:
        number, piece = piece if isinstance(piece, tuple) else (None, piece)
        after = line + piece.count("\n")
        if number:
            lines[number] = (line, after)
        line = after
        text += piece
    return text, lines


def cargo(*arguments):
    env = dict(os.environ, CARGO_TARGET_DIR=str(OUT / "target"), CARGO_PROFILE_MUTANTS_DEBUG="false")
    return subprocess.run(["cargo", *arguments], cwd=TREE, env=env, capture_output=True, text=True)


def lay_out(mutants):
    """Copies the changed files, with the branches."""
    TREE.mkdir(parents=True, exist_ok=True)
    listing = ["git", "ls-files", "-co", "--exclude-standard"]
    tracked = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\n")
    by_file = collections.defaultdict(list)
    for mutant in mutants:
        by_file[mutant["file"]].append(mutant)
    functions, lines = [], {}
    wanted = {"src/mutant_switch.rs": SWITCH}
    for name in filter(None, tracked):
        path = ROOT / name
        if not path.is_file():
            continue
        if name in by_file:
            wanted[name], lines[name] = branches(path, by_file[name], functions)
        elif name == "src/lib.rs":
            wanted[name] = path.read_text() + "\nmod mutant_switch;\n"
        else:
            wanted[name] = path.read_bytes()
    for name, content in wanted.items():
        content = content.encode() if isinstance(content, str) else content
        target = TREE / name
        if not target.is_file() or target.read_bytes() != content:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
            shutil.copymode(ROOT / name, target) if (ROOT / name).exists() else None
    for path in (TREE / "tests").rglob("*.rs"):
        if str(path.relative_to(TREE)) not in wanted:
            path.unlink()
    return functions, lines


def test_targets():
    tests = TREE / "tests"
    names = [p.stem for p in tests.glob("*.rs")] + [p.parent.name for p in tests.glob("*/main.rs")]
    return sorted(n for n in names if not SKIPPED_TESTS.match(n))


def build(mutants, unviable):
    """Builds without the mutants that do not compile. `unviable` has those of earlier builds, and gets the new ones."""
    while True:
        kept = [m for m in mutants if m["name"] not in unviable and not is_left_out(m)]
        functions, lines = lay_out(kept)
        arguments = ["test", "--profile", "mutants", *FEATURES, "--no-run", "--lib", "--message-format", "json"]
        for name in test_targets():
            arguments += ["--test", name]
        # A check finds most errors without code generation.
        checked = cargo("check", "--profile", "mutants", *FEATURES, "--lib", "--message-format", "json")
        done = checked if checked.returncode else cargo(*arguments)
        if done.returncode == 0:
            break
        names = {m["number"]: m["name"] for m in kept}
        found = {}
        for line in done.stdout.splitlines():
            message = json.loads(line)
            if message.get("reason") != "compiler-message" or message["message"]["level"] != "error":
                continue
            message = message["message"]
            for span in message["spans"]:
                if not span["is_primary"]:
                    continue
                # The error in a macro counts at the call of the macro.
                while span.get("expansion") and span["file_name"] not in lines:
                    span = span["expansion"]["span"]
                for number, (first, last) in lines.get(span["file_name"], {}).items():
                    if first <= span["line_start"] and span["line_end"] <= last:
                        found[names[number]] = message["message"]
        if not found:
            errors = [json.loads(l)["message"]["rendered"] for l in done.stdout.splitlines() if '"level":"error"' in l]
            sys.exit(f"build error outside of mutants:\n{done.stderr[-4000:]}\n" + "\n".join(errors)[:6000])
        print(f"{len(found)} do not compile", flush=True)
        unviable.update(found)
        (OUT / "unviable.json").write_text(json.dumps(unviable, indent=1))
    binaries = {}
    for line in done.stdout.splitlines():
        message = json.loads(line)
        if message.get("reason") == "compiler-artifact" and message.get("executable") and message["profile"]["test"]:
            binaries["lib" if "lib" in message["target"]["kind"] else message["target"]["name"]] = message["executable"]
    return functions, binaries


def limits():
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # A process group of its own, killed as a whole. Not a session: it would take a pseudo-terminal as its terminal.
    os.setpgid(0, 0)


def cpu_ticks(pid):
    """Returns the processor time of a process. A test in paused time that uses none is hung."""
    try:
        fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return int(fields[11]) + int(fields[12])
    except (OSError, IndexError):
        return None


def run_tests(binary, tests, mutant, timeout, trace=None, idle=math.inf):
    """Returns the failure, or None if all tests passed, and their processor time."""
    env = dict(os.environ, MUTANT=str(mutant), RUST_BACKTRACE="0", PROPTEST_FAILURE_PERSISTENCE="off")
    if trace:
        env["MUTANT_TRACE"] = trace
    process = subprocess.Popen(
        [binary, "--exact", "--test-threads", "2", *tests], cwd=TREE, env=env, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace", preexec_fn=limits)
    output = []
    reader = threading.Thread(target=lambda: output.append(process.stdout.read()))
    reader.start()
    began = last_active = time.monotonic()
    spent = None
    while reader.is_alive():
        reader.join(0.2)
        now = time.monotonic()
        before, spent = spent, cpu_ticks(process.pid)
        last_active = now if spent != before else last_active
        if now - began > timeout or now - last_active > idle:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            reader.join()
            return "timeout", now - began
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = usage.ru_utime + usage.ru_stime
    if process.returncode == 0:
        return None, seconds
    failed = re.findall(r"^test (\S+) .*FAILED", output[0], re.M)
    return failed[0] if failed else f"exit {process.returncode}", seconds


def trace(binaries, known):
    """Records the functions and the time of each test, alone. Tests of unchanged binaries are not run again."""
    jobs = []
    for name, binary in binaries.items():
        stamp = f"{binary} {os.stat(binary).st_mtime}"
        if known.get(name, {}).get("stamp") == stamp:
            continue
        out = subprocess.run([binary, "--list", "--format", "terse"], capture_output=True, text=True, check=True).stdout
        known[name] = {"stamp": stamp, "tests": {}}
        jobs += [(name, binary, t.removesuffix(": test")) for t in out.splitlines() if t.endswith(": test")]

    def one(job):
        name, binary, test = job
        with tempfile.NamedTemporaryFile() as file:
            failure, seconds = run_tests(binary, [test], 0, 400, trace=file.name)
            reached = sorted({int(n) for n in open(file.name).read().split()})
        if failure:
            print(f"skipped, fails without a mutant: {name} {test}: {failure}", flush=True)
        else:
            known[name]["tests"][test] = {"s": round(seconds, 4), "reached": reached}

    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        list(pool.map(one, jobs))
    return known


def schedule(function, known, budget):
    """Returns the tests that reach a function, in batches per binary, fastest first, up to budget seconds."""
    tests = [
        (t["s"] + (1 if name in WALL_CLOCK else 0), name, test)
        for name, b in known.items() for test, t in b["tests"].items() if function in t["reached"]
    ]
    tests.sort()
    batches, total, share = [], 0, 0.3
    while tests:
        batch, used, rest = collections.defaultdict(list), 0, []
        for seconds, name, test in tests:
            if used and used + seconds > share:
                rest.append((seconds, name, test))
            else:
                batch[name].append(test)
                used += seconds
        if total and total + used > budget:
            break
        batches += [(name, b, used) for name, b in batch.items()]
        total += used
        tests, share = rest, share * 3
    return batches


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["build", "run", "report"])
    parser.add_argument("-f", "--file", action="append", default=[], help="only files that match this pattern")
    parser.add_argument("--budget", type=float, default=10, help="test time per mutant in seconds [default: 10]")
    parser.add_argument("--again", action="store_true", help="run missed and timed out mutants again")
    parser.add_argument("-j", "--jobs", type=int, default=2, help="parallel jobs [default: 2]")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    results_path, known_path = OUT / "results.json", OUT / "known.json"
    results = json.loads(results_path.read_text()) if results_path.exists() else {}
    unviable_path = OUT / "unviable.json"
    unviable = json.loads(unviable_path.read_text()) if unviable_path.exists() else {}

    if options.command == "build":
        mutants = listed()
        functions, binaries = build(mutants, unviable)
        known = json.loads(known_path.read_text())["known"] if known_path.exists() else {}
        known = trace(binaries, {n: k for n, k in known.items() if n in binaries})
        state = {"known": known, "functions": functions, "binaries": binaries, "mutants": mutants}
        known_path.write_text(json.dumps(state))
        return
    state = json.loads(known_path.read_text())
    mutants = [
        m for m in state["mutants"] if not options.file or any(fnmatch.fnmatch(m["file"], f) for f in options.file)
    ]
    if options.command == "run":
        home = {number: f for f, numbers in enumerate(state["functions"]) for number in numbers}
        lock = threading.Lock()

        def one(mutant):
            before = results.get(mutant["name"])
            if mutant["number"] not in home or before and not (options.again and before[0] != "caught"):
                return
            verdict = ["missed", ""]
            for name, tests, seconds in schedule(home[mutant["number"]], state["known"], options.budget):
                timeout = 20 + 10 * seconds
                idle = math.inf if name in WALL_CLOCK else 3
                binary, number = state["binaries"][name], mutant["number"]
                failure, _ = run_tests(binary, tests, number, timeout, idle=idle)
                if failure and name in WALL_CLOCK:
                    failure, _ = run_tests(binary, tests, number, timeout)
                if failure:
                    verdict = ["timeout" if failure == "timeout" else "caught", f"{name} {failure}"]
                    break
            with lock:
                results[mutant["name"]] = verdict
                print(verdict[0], mutant["name"], verdict[1], flush=True)
                temporary = results_path.with_suffix(".new")
                temporary.write_text(json.dumps(results, indent=0))
                temporary.replace(results_path)

        with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(one, mutants))
        return
    count, missed = collections.defaultdict(collections.Counter), []
    for mutant in mutants:
        is_unviable = mutant["name"] in unviable and not is_left_out(mutant)
        verdict = "unviable" if is_unviable else results.get(mutant["name"], ["not run"])[0]
        count[mutant["file"]][verdict] += 1
        if verdict in ("missed", "not run"):
            missed.append(f"{verdict} {mutant['name']}")
    kinds = ["caught", "timeout", "missed", "unviable", "not run"]
    print("| file | " + " | ".join(kinds) + " |\n|---|" + "---|" * len(kinds))
    count["all"] = sum(count.values(), collections.Counter())
    for file, counter in count.items():
        print(f"| {file} | " + " | ".join(str(counter[k]) for k in kinds) + " |")
    found = count["all"]["caught"] + count["all"]["timeout"]
    total = found + count["all"]["missed"]
    print(f"\n{found} of {total} caught: {100 * found / max(1, total):.1f} %\n")
    print("\n".join(missed))


if __name__ == "__main__":
    main()
