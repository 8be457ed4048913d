"""Design the parafoil's thresholds on thousands of simulated flights, judge the detectors, print the paper's tables.

    python tools/parafoil_tables.py --design 2000 --faults 1000 --seed-design 1000000 --out out/parafoil
    python tools/parafoil_tables.py --design 2000 --judge 3000 --faults 1000 --seed-design 1000000 \\
        --seed-judge 900000000 --detector all --out out/parafoil

flies --design healthy flights and --faults of each class of fault (stuck motor, saturated motor, broken line, crossed
lines; sides with even chance, onset a whole second in 0..500 s), 600 s each, finds thresholds by the rules of
fdi/thresholds.py, and judges by --judge healthy flights and --faults a class of other seeds; without --judge by the
design flights, and says so.
Tables go to standard output and to OUT/tables.md, the paper's figures to OUT/figure_NN.png, flights to OUT/flights: a
command that was stopped goes on.  Intervals are Wilson's, 95 %.

Flights are flown and judged with the thresholds of configs/parafoil.toml.  --write record puts into that file's design
records what was measured with them; --write thresholds puts the thresholds found there, which then have to be flown.

Design seeds are below 100,000,000; judging seeds, from 900,000,000 on, are for one look after all choices are made.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fdi.parafoil as detector
import parafoil_figures as figures
from companion import airframe as airframes
from companion import campaign
from companion.airframe import Airframe
from companion.errors import UserError
from fdi.thresholds import Rates, Tail, trade_off
from intervals import share
from parafoil_design import (
    EQUAL,
    PAPER,
    WEIGHTS,
    Entry,
    PaperDesign,
    Sample,
    bank_of,
    delays,
    design_of_paper,
    edited,
    entries_of_ours,
    entries_of_paper,
    judged_rates,
    line_maxima,
    measures,
    motor_maxima,
    tail_of,
)
from parafoil_flights import (
    CLASS_STRIDE,
    FAULTY,
    FLIGHT_S,
    HEALTHY,
    KINDS,
    LINES,
    Campaign,
    Kind,
    Named,
    namings,
    outcome,
)

CONFIG = Path(__file__).parent.parent / "configs" / "parafoil.toml"
DESIGN_SEEDS_END = 100_000_000
JUDGING_SEEDS_BEGIN = 900_000_000

# The paper's tables, by WEIGHTS: threshold, P(FA), P(MD)
PAPER_1 = (
    Rates(0.3995, 0.000, 0.733),
    Rates(0.0995, 0.012, 0.172),
    Rates(0.0607, 0.032, 0.127),
    Rates(0.0574, 0.038, 0.119),
    Rates(0.0574, 0.038, 0.119),
    Rates(0.0573, 0.038, 0.119),
    Rates(0.0017, 0.999, 0.017),
)
PAPER_1_MERIT = (1.000, 0.956, 0.927, 0.921, 0.913, 0.897, 0.983)  # as printed; 0.927 does not follow from its row
PAPER_2 = ((0.000, 0.594), (0.005, 0.201), (0.051, 0.154), (0.058, 0.149), (0.058, 0.149), (0.058, 0.149), (0.796, 0.064))
PAPER_3 = (
    Rates(0.1363, 0.000, 0.094),
    Rates(0.1363, 0.000, 0.094),
    Rates(0.1238, 0.000, 0.093),
    Rates(0.1237, 0.001, 0.093),
    Rates(0.1198, 0.002, 0.092),
    Rates(0.1002, 0.015, 0.086),
    Rates(0.0074, 0.999, 0.040),
)
PAPER_3_MERIT = (1.000, 0.981, 0.962, 0.953, 0.944, 0.928, 0.960)
PAPER_4 = {  # P(DET), P(ISO), P(INC), P(FI)
    "left motor": (0.732, 0.969, 0.003, 0.029),
    "broken": (0.989, 0.990, 0.004, 0.006),
    "crossed": (0.997, 0.953, 0.019, 0.028),
}
PAPER_BROKEN = (0.07, 0.029, 0.001, 0.029)  # threshold; own crosses, other side stays, crossed stays (figure 12)
PAPER_CROSSED = (0.13, 0.138, 0.059)  # threshold; own crosses, broken stays (figure 13)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bar:
    """What a measure has to lie within."""

    measure: str
    low: float
    high: float


BARS = {
    "paper": (
        Bar("threshold found", 0.035, 0.055),
        Bar("FOM", 0.905, 0.935),
        Bar("P(FA)", 0.0, 0.05),
        Bar("P(DET) stuck", 0.93, 0.98),
        Bar("P(DET) saturation", 0.44, 0.56),
        Bar("P(DET) left motor", 0.69, 0.77),
        Bar("P(DET) broken", 0.91, 0.975),
        Bar("P(DET) crossed", 0.99, 1.0),
        Bar("P(ISO) stuck", 0.985, 1.0),
        Bar("P(ISO) saturation", 0.985, 1.0),
        Bar("P(ISO) broken", 0.985, 1.0),
        Bar("P(ISO) crossed", 0.95, 0.99),
    ),
    "gps": (
        Bar("P(FA)", 0.0, 0.005),
        Bar("P(DET) stuck", 0.99, 1.0),
        Bar("P(DET) saturation", 0.985, 1.0),
        Bar("P(DET) broken", 0.98, 1.0),
        Bar("P(DET) crossed", 0.99, 1.0),
        Bar("mixture P(MD)", 0.0, 0.010),
        *(Bar(f"P(ISO) {kind.name}", 0.99, 1.0) for kind in FAULTY),
        *(Bar(f"P(FI) {kind.name}", 0.0, 0.005) for kind in FAULTY),
        Bar("median s all", 0.0, 4.5),
        Bar("median s stuck", 0.0, 0.8),
        Bar("median s saturation", 0.0, 9.0),
        Bar("median s broken", 0.0, 12.0),
        Bar("median s crossed", 0.0, 3.5),
    ),
    "gyro": (
        Bar("P(FA)", 0.0, 0.003),
        *(Bar(f"P(DET) {kind.name}", 0.99, 1.0) for kind in FAULTY),
        Bar("mixture P(MD)", 0.0, 0.005),
        *(Bar(f"P(ISO) {kind.name}", 0.99, 1.0) for kind in FAULTY),
        Bar("median s broken", 0.0, 7.5),
        Bar("median s crossed", 0.0, 1.5),
    ),
}


# -- tables -------------------------------------------------------------------------------------------------------------


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table and an empty line."""
    lines = [header, ["---"] * len(header), *rows]
    return [*(f"| {' | '.join(cells)} |" for cells in lines), ""]


def with_interval(of: float, count: int) -> str:
    return share(round(of * count), count)


def quantiles(times_s: FloatArray) -> str:
    known = times_s[np.isfinite(times_s)]
    return "-" if known.size == 0 else f"{np.median(known):.1f}/{np.quantile(known, 0.9):.1f}"


def weights_table(
    found: Sequence[Rates], papers: Sequence[Rates], merits: Sequence[float], healthy: int, faulty: int
) -> list[str]:
    """Tables 1 and 3."""
    rows = [
        [
            f"{weight:.1f}",
            f"{ours.threshold:.4f} ({paper.threshold:.4f})",
            f"{with_interval(ours.false_alarms, healthy)} ({paper.false_alarms:.3f})",
            f"{with_interval(ours.missed, faulty)} ({paper.missed:.3f})",
            f"{ours.merit(weight):.3f} ({merit:.3f})",
        ]
        for weight, ours, paper, merit in zip(WEIGHTS, found, papers, merits, strict=True)
    ]
    return table(("c1", "threshold", "P(FA)", "P(MD)", "FOM"), rows)


def predicted_table(found: Sequence[Rates], judged: Sequence[Rates], sample: Sample) -> list[str]:
    """Table 2."""
    healthy, faulty = sample.healthy.count, sample.mixture.count
    rows = [
        [
            f"{designed.threshold:.4f} ({paper.threshold:.4f})",
            f"{designed.false_alarms:.3f} ({paper.false_alarms:.3f})",
            f"{with_interval(seen.false_alarms, healthy)} ({seen_by_paper[0]:.3f})",
            f"{designed.missed:.3f} ({paper.missed:.3f})",
            f"{with_interval(seen.missed, faulty)} ({seen_by_paper[1]:.3f})",
        ]
        for designed, seen, paper, seen_by_paper in zip(found, judged, PAPER_1, PAPER_2, strict=True)
    ]
    return table(("threshold", "P(FA) predicted", "P(FA) judged", "P(MD) predicted", "P(MD) judged"), rows)


def elimination_table(design: PaperDesign, sample: Sample) -> list[str]:
    (own, other, crossed), (own_crossed, broken) = line_maxima(sample)
    values = (
        ("broken line", design.broken, (own, other, crossed), PAPER_BROKEN, ("other side stays", "crossed stays")),
        ("crossed lines", design.crossed, (own_crossed, broken), PAPER_CROSSED, ("broken stays",)),
    )
    rows = []
    for name, found, maxima, (threshold, own_crosses, *stay), labels in values:
        first = f"{with_interval(found.own_crosses, maxima[0].size)} ({own_crosses:.3f})"
        stays = [
            f"{label} {with_interval(ours, other.size)} ({papers:.3f})"
            for label, ours, other, papers in zip(labels, found.others_stay, maxima[1:], stay, strict=True)
        ]
        rows.append([name, f"{found.threshold:.4f} ({threshold:.2f})", first, "; ".join(stays)])
    return table(("residual of", "threshold", "own fault crosses", "others stay"), rows)


def judgement_table(sample: Sample) -> list[str]:
    """Table 4, in the paper's rows where the paper's method is judged."""
    rows = []
    for name, flights in sample.groups().items():
        if name in ("both motor faults", "left motor") and not sample.by_papers_rule:
            continue
        seen = outcome(flights, sample.by_papers_rule)
        detected, papers = int(seen.detected.sum()), PAPER_4.get(name) if sample.by_papers_rule else None
        counts = (
            (detected, flights.count),
            *((int(each.sum()), detected) for each in (seen.right, seen.inconclusive, seen.wrong)),
        )
        cells = [share(count, of) for count, of in counts]
        if papers is not None:
            cells = [f"{cell} ({value:.3f})" for cell, value in zip(cells, papers, strict=True)]
        early = share(int(flights.early.sum()), flights.count)
        rows.append([name, *cells, early, quantiles(seen.detected_s), quantiles(seen.isolated_s)])
    header = ("fault", "P(DET)", "P(ISO)", "P(INC)", "P(FI)", "alarm before", "detected 50/90 % s", "named 50/90 % s")
    return table(header, rows)


def bars_table(values: Mapping[str, float], bars: Sequence[Bar]) -> list[str]:
    rows = [
        [
            bar.measure,
            f"{values[bar.measure]:.4f}",
            f"{bar.low:g} to {bar.high:g}",
            "met" if bar.low <= values[bar.measure] <= bar.high else "**missed**",
        ]
        for bar in bars
    ]
    return table(("measure", "value", "bar", ""), rows)


def judgement(sample: Sample, thresholds: str, extra: Mapping[str, float]) -> list[str]:
    """One detector judged: false alarms, Table 4, the mixture, the bars."""
    values = {**measures(sample), **extra}
    rule = (
        "An alarm that stands at the onset counts as detected, and what is only detected 90 s after it is named by size."
        if sample.by_papers_rule
        else "A flight with an alarm before the onset counts as missed; what is not named in 90 s is inconclusive."
    )
    healthy, mixture = sample.healthy, sample.mixture
    missed = mixture.count - int(outcome(mixture, sample.by_papers_rule).detected.sum())
    alarms = int(healthy.early.sum())
    spread = 0.5 * math.sqrt(variance(alarms, healthy.count) + variance(missed, mixture.count))
    papers = {"alarms": " (paper 0.038 designed, 0.058 judged)", "missed": " (paper 0.119 designed, 0.149 judged)"}
    papers["merit"] = " (paper 0.921)"
    if not sample.by_papers_rule:
        papers = dict.fromkeys(papers, "")
    return [
        f"{sample.told}; {thresholds}. {rule}",
        "",
        *judgement_table(sample),
        f"- P(FA) a flight: {share(alarms, healthy.count)}{papers['alarms']}",
        f"- mixture P(MD): {share(missed, mixture.count)}{papers['missed']}",
        f"- figure of merit at equal weights: {values['FOM']:.4f}, give or take {1.96 * spread:.4f}{papers['merit']}",
        f"- median time from onset to detection, all faults: {values['median s all']:.1f} s",
        "",
        *bars_table(values, BARS[sample.detector]),
    ]


def variance(count: int, of: int) -> float:
    """Of a share that was counted."""
    return count / of * (1.0 - count / of) / of


def record_table(named: Sequence[Named], delays_s: Mapping[str, float]) -> list[str]:
    """What the paper's monitor keeps of its design: confidence by way and class, delay of detection."""
    rows = []
    for each in named:
        name = "motor" if each.way == "motor" else f"{each.fault_class} by {each.way}"
        rows.append([name, f"{share(each.right, each.count)} of {each.count}" if each.count else "never named so"])
    rows += [[f"delay, {name}", f"{delay_s:.1f} s"] for name, delay_s in delays_s.items()]
    return table(("design record", ""), rows)


def gather(airframe: Airframe, name: str, kept: Campaign, first_seed: int, kinds: Mapping[Kind, int], told: str) -> Sample:
    """Fly what is missing of a detector's flights; kinds: how many of each."""
    judge = campaign.with_detector(airframe, name)
    flights = {kind: kept.gather(judge, kind, first_seed, count) for kind, count in kinds.items()}
    counted = f"{kinds[HEALTHY]} healthy"
    if len(kinds) > 1:
        counted += f" and {kinds[FAULTY[0]]} of each class"
    line = ", behind a line that rounds, loses and delays" if kept.link else ""
    return Sample(
        name,
        f"{told}: {counted}, seeds from {first_seed}{line}",
        flights[HEALTHY],
        {kind.name: each for kind, each in flights.items() if kind is not HEALTHY},
    )


def command_of(arguments: argparse.Namespace) -> str:
    """What gives a design again."""
    others = "" if arguments.duration == FLIGHT_S else f" --duration {arguments.duration:g}"
    others += " --link" if arguments.link else ""
    return (
        f"tools/parafoil_tables.py --detector {arguments.detector} --design {arguments.design} --faults {arguments.faults} "
        f"--seed-design {arguments.seed_design}{others}"
    )


def parse(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--design", metavar="N", type=int, default=2000, help="healthy design flights; 2000")
    parser.add_argument(
        "--judge", metavar="N", type=int, default=0, help="healthy judging flights; 0: judge by the design's"
    )
    parser.add_argument("--faults", metavar="N", type=int, default=1000, help="flights of each class, of either sort; 1000")
    parser.add_argument("--seed-design", metavar="N", type=int, required=True, help="of the first design flight")
    parser.add_argument("--seed-judge", metavar="N", type=int, help="of the first judging flight")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="for flights, tables and figures")
    parser.add_argument("--detector", choices=[*detector.DETECTORS, "all"], default=PAPER, help="paper")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="processes; 1")
    parser.add_argument("--duration", metavar="S", type=float, default=FLIGHT_S, help="of a flight; 600")
    parser.add_argument("--link", action="store_true", help="rows as through a line that rounds, loses and delays")
    parser.add_argument(
        "--write", choices=["record", "thresholds"], help="into configs/parafoil.toml, between design and judging"
    )
    arguments = parser.parse_args(words)
    if min(arguments.design, arguments.faults, arguments.jobs) < 1 or arguments.judge < 0:
        parser.error("--design, --faults and --jobs are at least 1, --judge at least 0")
    if not 1.0 <= arguments.duration <= 36000.0:
        parser.error(f"--duration {arguments.duration:g} is no duration of a flight; give seconds from 1 on")
    if max(arguments.design, arguments.judge, arguments.faults) > CLASS_STRIDE:
        parser.error(f"at most {CLASS_STRIDE} flights of a kind: their seeds would meet")
    last = DESIGN_SEEDS_END - (len(KINDS) + 1) * CLASS_STRIDE
    if not 0 <= arguments.seed_design <= last:
        parser.error(
            f"--seed-design {arguments.seed_design}: give 0 to {last}; all kinds stay below {DESIGN_SEEDS_END} then"
        )
    if arguments.judge and (arguments.seed_judge is None or arguments.seed_judge < JUDGING_SEEDS_BEGIN):
        parser.error(f"--judge needs --seed-judge from {JUDGING_SEEDS_BEGIN} on, where nothing was designed")
    return arguments


def configured(airframe: Airframe) -> detector.Config:
    config = airframe.monitor_config
    assert isinstance(config, detector.Config)
    return config


def run(arguments: argparse.Namespace) -> list[str]:
    """Fly, find, judge and draw; -> the page.  Raises UserError."""
    airframe = airframes.load("parafoil")
    kept = Campaign(arguments.out, arguments.jobs, arguments.link, arguments.duration)
    names = detector.DETECTORS if arguments.detector == "all" else (arguments.detector,)
    faults = dict.fromkeys(FAULTY, arguments.faults)
    designs: dict[str, Sample] = {}
    for name in names:
        wanted = {HEALTHY: arguments.design}
        if name == PAPER or not arguments.judge:  # ours is designed on healthy flights alone
            wanted |= faults
        designs[name] = gather(airframe, name, kept, arguments.seed_design, wanted, "Design flights")
    config = configured(airframe)
    found = design_of_paper(designs[PAPER]) if PAPER in designs else None
    tails = {name: tail_of(sample, config) for name, sample in designs.items() if name != PAPER}
    if arguments.write:
        write(arguments, config, designs, found, tails)
        airframe = airframes.load("parafoil")
        config = configured(airframe)
    judged = dict(designs)
    if arguments.judge:
        wanted = {HEALTHY: arguments.judge, **faults}
        judged = {name: gather(airframe, name, kept, arguments.seed_judge, wanted, "Judging flights") for name in names}
    page = ["# The parafoil's tables", "", f"    python {command_of(arguments)}" + _judged_by(arguments), ""]
    page += ["Shares with Wilson 95 % intervals; the paper's value in brackets.", ""]
    if found is not None:
        page += page_of_paper(designs[PAPER], judged[PAPER], found, config, arguments)
    for name, tail in tails.items():
        page += page_of_ours(designs[name], judged[name], tail, config)
    if found is not None:
        draw(arguments, campaign.with_detector(airframe, PAPER), designs[PAPER], judged[PAPER], found)
    return page


def _judged_by(arguments: argparse.Namespace) -> str:
    return f" --judge {arguments.judge} --seed-judge {arguments.seed_judge}" if arguments.judge else ""


def write(
    arguments: argparse.Namespace,
    config: detector.Config,
    designs: Mapping[str, Sample],
    found: PaperDesign | None,
    tails: Mapping[str, Tail],
) -> None:
    """Into the packaged configuration: the record of this design, or its thresholds."""
    command, thresholds = command_of(arguments), arguments.write == "thresholds"
    entries: list[Entry] = []
    for name, sample in designs.items():
        if name == PAPER and found is not None:
            entries += entries_of_paper(sample, found, config, command, arguments.seed_design, thresholds=thresholds)
        else:
            entries += entries_of_ours(sample, tails[name], command, arguments.seed_design, thresholds=thresholds)
    CONFIG.write_text(edited(CONFIG.read_text(encoding="utf-8"), entries), encoding="utf-8")
    print(f"{CONFIG}: {len(entries)} values written", file=sys.stderr)


def page_of_paper(
    design: Sample, judged: Sample, found: PaperDesign, config: detector.Config, arguments: argparse.Namespace
) -> list[str]:
    limits = config.paper.thresholds
    flown = (
        f"flown with the thresholds {limits.heading_rate_rad2_s2:g} (rad/s)², {limits.motor_m:g} m, "
        f"{limits.broken_rad2_s2:g} and {limits.crossed_rad2_s2:g} (rad/s)²"
    )
    if arguments.judge:
        predicted = predicted_table(found.heading_rate, judged_rates(found.heading_rate, judged), judged)
    else:
        predicted = ["Not judged: no judging flights were asked for.", ""]
    return [
        "## The paper's method",
        "",
        *section_of_heading_rate(design, found),
        "### Table 2: predicted and judged (figure 7)",
        "",
        *predicted,
        *section_of_motors(design, found),
        "### Fault-specific thresholds, (rad/s)² (figures 12 and 13)",
        "",
        "Largest value of the 90 s from the onset, both sides together.",
        "",
        *elimination_table(found, design),
        "### Table 4: detection and isolation",
        "",
        *judgement(judged, flown, {"threshold found": found.heading_rate[EQUAL].threshold}),
        "First namings by the live monitor that were right, of as many design flights of each kind, healthy among them; and "
        "medians from onset to detection.",
        "",
        *record_table(namings(design.even), delays(design)),
    ]


def section_of_heading_rate(design: Sample, found: PaperDesign) -> list[str]:
    at_papers = judged_rates([PAPER_1[i] for i in (6, 3, 1, 0)], design)
    told = (f"{each.threshold:.4f}: P(FA) {each.false_alarms:.3f}, P(MD) {each.missed:.3f}" for each in at_papers)
    return [
        "### Table 1: thresholds of the heading-rate residual, (rad/s)² (figure 6)",
        "",
        f"{design.told}. Healthy: largest value of the flight; fault: of the 60 s from the onset.",
        "",
        *weights_table(found.heading_rate, PAPER_1, PAPER_1_MERIT, design.healthy.count, design.mixture.count),
        f"At the paper's own thresholds: {'; '.join(told)}.",
        "",
    ]


def section_of_motors(design: Sample, found: PaperDesign) -> list[str]:
    _, named, in_60 = motor_maxima(design)
    best = found.motor_60
    return [
        "### Table 3: thresholds of the motor residual, m (figure 10)",
        "",
        f"Healthy: the larger of both motors; fault: the faulty motor in the 5 s from detection, {named.size} flights.",
        "",
        *weights_table(found.motor, PAPER_3, PAPER_3_MERIT, design.healthy.count, named.size),
        f"With the 60 s from the onset of all {in_60.size} motor faults instead, at equal weights: {best.threshold:.4f} m, "
        f"P(FA) {best.false_alarms:.3f}, P(MD) {best.missed:.3f}.",
        "",
    ]


def page_of_ours(design: Sample, judged: Sample, tail: Tail, config: detector.Config) -> list[str]:
    bank = bank_of(design.detector, config)
    seen = int(design.healthy.early.sum())
    return [
        f"## Ours, {design.detector}",
        "",
        f"{design.told}. Exponential tail of the largest sum: {tail.flights} flights above {tail.quantile:.2f}, mean excess "
        f"{tail.mean_excess:.2f}; for {bank.design.false_alarms_per_flight:g} false alarms a flight a threshold of "
        f"**{tail.threshold:.2f}**. Configured: {bank.threshold:g}; with it {seen} of these flights have an alarm.",
        "",
        *judgement(judged, f"flown with the threshold {bank.threshold:g}", {}),
    ]


def draw(arguments: argparse.Namespace, airframe: Airframe, design: Sample, judged: Sample, found: PaperDesign) -> None:
    """The paper's figures."""
    folder: Path = arguments.out
    healthy, mixture = design.healthy.numbers("peak_heading_rate"), design.mixture.numbers("peak_60_heading_rate")
    best, motor = found.heading_rate[EQUAL], found.motor[EQUAL]
    motor_healthy, motor_faulty, _ = motor_maxima(design)
    (own, other, crossed), (own_crossed, broken) = line_maxima(design)
    turn_unit = figures.RESIDUAL_UNIT
    figures.draw_distributions(
        folder / "figure_06.png", [("healthy", healthy), ("fault", mixture)], best.threshold, turn_unit, best
    )
    simulated = judged_rates(found.heading_rate, judged) if arguments.judge else []
    figures.draw_trade_off(folder / "figure_07.png", trade_off(healthy, mixture), found.heading_rate, simulated, PAPER_2)
    figures.draw_distributions(
        folder / "figure_10.png", [("healthy", motor_healthy), ("motor fault", motor_faulty)], motor.threshold, "m", motor
    )
    figures.draw_distributions(
        folder / "figure_12.png",
        [("that line broken", own), ("the other line broken", other), ("lines crossed", crossed)],
        found.broken.threshold,
        turn_unit,
    )
    figures.draw_distributions(
        folder / "figure_13.png",
        [("lines crossed", own_crossed), ("line broken", broken)],
        found.crossed.threshold,
        turn_unit,
    )
    right_stuck, left_stuck, left_broken = figures.fly_examples(airframe, arguments.seed_design + len(KINDS) * CLASS_STRIDE)
    figures.draw_tracking(folder / "figure_08.png", right_stuck, 1)
    figures.draw_motor_phase(folder / "figure_15.png", left_stuck)
    figures.draw_motor_phase(folder / "figure_16.png", left_broken)
    figures.draw_line_residuals(folder / "figure_17.png", left_broken, LINES[:2])
    figures.draw_line_residuals(folder / "figure_18.png", left_broken, LINES[2:])


def main(words: Sequence[str] | None = None) -> int:
    arguments = parse(words)
    try:
        page = "\n".join(run(arguments)).rstrip() + "\n"
    except UserError as error:
        print(f"parafoil_tables: {error}", file=sys.stderr)
        return 2
    (arguments.out / "tables.md").write_text(page, encoding="utf-8")
    print(page, end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
