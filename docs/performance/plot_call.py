#!/usr/bin/env python3
"""Draws call.svg from call.csv: how near calls come to the limit and to the peer. Needs matplotlib.

    cargo bench --bench call -- --csv && python3 docs/performance/plot_call.py
"""

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
WAYS = {
    "fatek-binary": ("read_registers, binary", "#1f77b4", "o"),
    "into-binary": ("read_registers_into, binary", "#1f77b4", "s"),
    "fatek-ascii": ("read_registers, ASCII", "#d95f02", "o"),
    "into-ascii": ("read_registers_into, ASCII", "#d95f02", "s"),
}


def label(setting):
    runtime, links, callers = setting
    who = f"{links} links" if links != "1" else "1 link"
    return f"{runtime}\n{who}, {callers} caller{'' if callers == '1' else 's'} each"


def main():
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "call.svg"
    rows = list(csv.DictReader((HERE / "call.csv").open()))
    settings = list(dict.fromkeys((r["runtime"], r["links"], r["callers"]) for r in rows))
    figure, axes = plt.subplots(1, 2, figsize=(12, 6.5), sharey=True)
    for axis, name, title, goal in (
        (axes[0], "limit", "of a bare write and read of the same bytes", 0.9),
        (axes[1], "peer", "of tokio-modbus, as many registers", 1.0),
    ):
        axis.axvline(goal, color="#888888", linestyle="--", linewidth=1, label=f"target, {goal}")
        for offset, (way, (text, color, marker)) in enumerate(WAYS.items()):
            mine = {(r["runtime"], r["links"], r["callers"]): r for r in rows if r["way"] == way}
            for place, setting in enumerate(settings):
                row = mine.get(setting)
                if not row or not row[f"{name}_median"]:
                    continue
                low, middle, high = (float(row[f"{name}_{part}"]) for part in ("low", "median", "high"))
                y = place + (offset - 1.5) * 0.17
                axis.plot([low, high], [y, y], color=color, linewidth=2, alpha=0.45)
                axis.plot(middle, y, marker, color=color, markersize=6, label=text if place == 0 else None)
        axis.set_xlabel(f"requests a second, as a share {title}")
        axis.set_yticks(range(len(settings)), [label(setting) for setting in settings])
        axis.grid(axis="x", alpha=0.3)
        axis.set_xlim(left=min(0.5, axis.get_xlim()[0]))
    axes[0].invert_yaxis()
    axes[0].set_title("the limit")
    axes[1].set_title("the peer")
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles[1:], labels[1:], loc="lower center", ncols=4, frameon=False)
    figure.suptitle("64 registers read over loopback TCP: medians of the ratios of interleaved rounds, and their middle half")
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    figure.savefig(target)


if __name__ == "__main__":
    main()
