"""Has the machine changed?  Rules over its history of calibrations, with a false-alarm probability that is stated.

Every number of the calibrations is tested by four rules, each with a probability by chance:

| rule | finds | test |
|---|---|---|
| single run | one run off the others | its distance from the other runs' mean, at each run |
| step | a sudden lasting change | difference of the means before and after, at each place (change point) |
| EWMA | a small lasting change, from the run where it began | exponentially weighted mean of standardised runs |
| trend | wear or creep | slope over the runs |

Variances are the stated ones plus a between-runs scatter that is estimated from the runs themselves.  That a few runs
scatter no more than they state does not prove that the machine does not, so the reference is Student's t with the runs'
degrees of freedom throughout; the stated uncertainties are a lower bound.  The EWMA standardises each run by the runs
before it, so its values are independent and need no baseline that is known beforehand (self-starting charts: D. M.
Hawkins, Journal of Quality Technology 19 (1987) 255).  With a baseline period the other rules compare with it alone.
Each probability is multiplied by the number of places, of rules and of numbers (Bonferroni): one look at a history
without a change raises an alarm with a probability of at most `FALSE_ALARM`.  Looks at a growing history resemble one
another, so that the mean number of runs to a false alarm is far above 1 / FALSE_ALARM; docs/validation/trust.md states
what a simulation gave.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri, stdtr

from tomopose.calibration.records.charts import (
    FEWEST_RUNS,
    RESIDUAL,
    Series,
    between_runs,
    from_others,
    series,
)
from tomopose.calibration.records.history import Entry, name_of
from tomopose.calibration.records.setup import scanner_changes
from tomopose.errors import InputError
from tomopose.manipulator.poses import PIVOT_TOLERANCE_MM
from tomopose.units import Array, value_with_uncertainty

FALSE_ALARM = 0.01
"""Largest probability of a false alarm in one look at the history, over all numbers, rules and places together."""

RULES = 4
WEIGHT = 0.2
"""Of the newest run in the exponentially weighted mean: the usual 0.2 reacts best to changes of about one standard
deviation (Lucas and Saccucci, Technometrics 32 (1990) 1)."""

FEWEST_SIDE = 2
"""Runs on each side of a step; a single one is the single-run rule's."""


@dataclass(frozen=True, kw_only=True)
class Alarm:
    """One number that changed.

    rule: single run | step | EWMA | trend;  run, label, time_utc: from which run on, or which run;
    size, u: of the change, in `unit`;  p: probability by chance, all looks counted.
    """

    parameter: str
    rule: str
    run: int
    label: str
    time_utc: str
    size: float
    u: float
    unit: str
    p: float

    @property
    def words(self) -> str:
        """A sentence."""
        sign = "+" if self.size > 0 else "-"
        amount = f"{sign}{value_with_uncertainty(abs(self.size), self.u, self.unit)}"
        course = {
            "single run": f"{self.parameter} of run {self.label} is off by {amount}",
            "step": f"{self.parameter} changed by {amount} from {self.label} on",
            "EWMA": f"{self.parameter} is off by {amount} on average from {self.label} on",
            "trend": f"{self.parameter} has moved by {amount} since {self.label}, run after run",
        }[self.rule]
        return f"{course} ({self.rule}, p = {self.p:.1g})"

    def to_json(self) -> dict[str, float | int | str]:
        suffix = f"_{self.unit}" if self.unit else ""
        return {
            "parameter": self.parameter,
            "rule": self.rule,
            "run": self.run + 1,
            "from_label": self.label,
            "from_time_utc": self.time_utc,
            f"step{suffix}": self.size,
            f"u{suffix}": self.u,
            "p": self.p,
            "words": self.words,
        }


@dataclass(frozen=True, kw_only=True)
class Monitoring:
    """The judgement of a history.

    alarms: one for each number that changed, the surest first;  judged: places of the runs that were compared;
    notes: runs that were left out, and why;  words: the answer, one sentence a line.
    """

    alarms: tuple[Alarm, ...]
    judged: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def words(self) -> tuple[str, ...]:
        n = len(self.judged)
        if self.alarms:
            return tuple(f"alarm: {a.words}" for a in self.alarms)
        if n < FEWEST_RUNS:
            return (f"no judgement yet: {n} comparable calibrations; the rules start with {FEWEST_RUNS}",)
        return (
            f"no alarm: {n} calibrations agree (single runs, steps, lasting shifts, trends; one look raises a false "
            f"alarm with a probability of at most {FALSE_ALARM:.0%})",
        )

    def to_json(self) -> dict[str, object]:
        return {
            "alarm": bool(self.alarms),
            "alarms": [a.to_json() for a in self.alarms],
            "judged": len(self.judged),
            "false_alarm_probability": FALSE_ALARM,
            "words": [*self.words, *self.notes],
        }


def baseline_runs(entries: Sequence[Entry], text: str | None) -> tuple[int, int | None]:
    """(first run, run after the last of the baseline period, or None for an open one) of "FROM" or "FROM:TO".

    FROM and TO are labels or the runs' numbers, counted from 1.  Without a text everything counts, from the first run.
    """
    if not text:
        return 0, None
    parts = text.split(":")
    if len(parts) > 2:
        raise InputError(f"the baseline {text!r} is not FROM or FROM:TO, with labels or numbers of runs")
    start = _place(entries, parts[0]) if parts[0] else 0
    if len(parts) == 1:
        return start, None
    stop = _place(entries, parts[1]) + 1
    if stop - start < FEWEST_RUNS:
        raise InputError(f"the baseline {text!r} holds {max(stop - start, 0)} runs; at least {FEWEST_RUNS} are needed")
    return start, stop


def _place(entries: Sequence[Entry], word: str) -> int:
    labelled = [k for k, e in enumerate(entries) if e.get("label") == word]
    if labelled:
        return labelled[-1]
    if word.isdigit() and 1 <= int(word) <= len(entries):
        return int(word) - 1
    raise InputError(f"the history has no run labelled {word!r}; its runs are {_some(entries)}")


def _some(entries: Sequence[Entry]) -> str:
    names = [name_of(e) for e in entries]
    return ", ".join(names) if len(names) <= 6 else f"{', '.join(names[:3])}, ..., {names[-1]}"


def comparable(entries: Sequence[Entry], start: int = 0) -> tuple[list[int], list[str]]:
    """(places of the runs that can be compared with the last one, sentences on the others).

    Where scanner.json, the pivot or the machine differ, T_HT is another quantity; a rejected run has no values.
    """
    judged: list[int] = []
    left_out: dict[str, list[str]] = {}
    if not entries:
        return judged, []
    last = entries[-1]
    for k in range(start, len(entries)):
        why = _why_not(entries[k], last)
        if why:
            left_out.setdefault(why, []).append(name_of(entries[k]))
        else:
            judged.append(k)
    notes = [f"not judged, {why}: {_listed(names)}" for why, names in left_out.items()]
    return judged, notes


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{names[0]} to {names[-1]} ({len(names)} runs)"


def _why_not(entry: Entry, last: Entry) -> str:
    if entry.get("verdict") == "rejected":
        return "the calibration is rejected"
    if entry.get("machine") and last.get("machine") and entry["machine"] != last["machine"]:
        return f"another machine ({entry['machine']})"
    changes = scanner_changes(entry.get("scanner") or {}, last.get("scanner") or {})
    if changes:
        return f"scanner.json changed since ({'; '.join(changes)})"
    a, b = entry.get("pivot_mm"), last.get("pivot_mm")
    if a is not None and b is not None and np.abs(np.subtract(a, b)).max() > PIVOT_TOLERANCE_MM:
        return f"another pivot ({a} mm, now {b} mm)"
    return ""


def monitor(entries: Sequence[Entry], *, baseline: str | None = None) -> Monitoring:
    """Judge a history; see the module.  baseline: of `baseline_runs`; runs before it play no part.

    InputError for a baseline that the history does not hold.
    """
    start, stop = baseline_runs(entries, baseline)
    judged, notes = comparable(entries, start)
    runs = [entries[k] for k in judged]
    n_base = None if stop is None else sum(k < stop for k in judged)
    if n_base is not None and n_base < FEWEST_RUNS:
        raise InputError(
            f"only {n_base} runs of the baseline {baseline!r} can be compared with the last run; {'; '.join(notes)}"
        )
    names = [*dict.fromkeys(name for e in runs for name in e["parameters"]), RESIDUAL]
    found = [s for s in (series(runs, name) for name in names) if len(s.value) >= FEWEST_RUNS]
    looks = RULES * max(len(found), 1)
    alarms = []
    for one in found:
        sure = [c for c in _candidates(one, n_base) if c.p * looks < FALSE_ALARM]
        # the average has no place of its own: it is named where nothing else is significant
        best = min(sure, key=lambda c: (c.rule == "EWMA", c.p), default=None)
        if best is not None:
            k = judged[int(one.place[best.at])]
            alarms.append(
                Alarm(
                    parameter=one.name,
                    rule=best.rule,
                    run=k,
                    label=name_of(entries[k]),
                    time_utc=str(entries[k].get("time_utc", "")),
                    size=best.size,
                    u=best.u,
                    unit=one.unit,
                    p=min(1.0, best.p * looks),
                )
            )
    order = sorted(alarms, key=lambda a: a.p)
    return Monitoring(alarms=tuple(order), judged=tuple(judged), notes=tuple(notes))


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    """A rule's most significant place: p by chance, all its places counted."""

    rule: str
    at: int
    size: float
    u: float
    p: float


def _candidates(s: Series, n_base: int | None) -> Iterator[_Candidate]:
    """What each rule finds."""
    base = None if n_base is None else int((s.place < n_base).sum())
    if base is not None and base < FEWEST_RUNS:
        return
    rules = (_step, _single, _ewma, _trend)
    yield from (c for c in (rule(s.value, s.u, base) for rule in rules) if c is not None)


def _p(size: float, variance: float, dof: int) -> float:
    return float(2 * stdtr(dof, -abs(size) / np.sqrt(variance)))


def _step(value: Array, u: Array, base: int | None) -> _Candidate | None:
    """The place where the means before (of the baseline period, where there is one) and after differ most surely."""
    n = len(value)
    first = FEWEST_SIDE if base is None else base
    places = range(first, n - FEWEST_SIDE + 1)
    best: _Candidate | None = None
    for k in places:
        before = np.arange(k if base is None else base)
        size, variance, dof = _difference(value, u, before, np.arange(k, n))
        p = _p(size, variance, dof)
        if best is None or p < best.p:
            best = _Candidate(rule="step", at=k, size=size, u=float(np.sqrt(variance)), p=p)
    return None if best is None else _counted(best, len(places))


def _counted(c: _Candidate, places: int) -> _Candidate:
    return _Candidate(rule=c.rule, at=c.at, size=c.size, u=c.u, p=min(1.0, c.p * places))


def _difference(value: Array, u: Array, before: np.ndarray, after: np.ndarray) -> tuple[float, float, int]:
    """(mean after minus mean before, its variance, its degrees of freedom), one between-runs scatter for both."""
    w = 1.0 / u**2
    means = [float((w[g] * value[g]).sum() / w[g].sum()) for g in (before, after)]
    squares = sum(float((w[g] * (value[g] - m) ** 2).sum()) for g, m in zip((before, after), means, strict=True))
    between = between_runs(squares, w, [before, after])
    w = 1.0 / (u**2 + between)
    means = [float((w[g] * value[g]).sum() / w[g].sum()) for g in (before, after)]
    variance = float(sum(1.0 / w[g].sum() for g in (before, after)))
    return means[1] - means[0], variance, len(before) + len(after) - 2


def _single(value: Array, u: Array, base: int | None) -> _Candidate | None:
    """The run that is farthest off the others, or off the baseline period."""
    n = len(value)
    places = range(n) if base is None else range(base, n)
    best: _Candidate | None = None
    for k in places:
        others = np.delete(np.arange(n), k) if base is None else np.arange(base)
        size, variance, dof = _standing(value, u, k, others)
        p = _p(size, variance, dof)
        if best is None or p < best.p:
            best = _Candidate(rule="single run", at=k, size=size, u=float(np.sqrt(variance)), p=p)
    return None if best is None else _counted(best, len(places))


def _standing(value: Array, u: Array, k: int, others: np.ndarray) -> tuple[float, float, int]:
    """(run k minus the mean of the others, its variance, its degrees of freedom)."""
    centre, variance, _ = from_others(value, u, k, others)
    return float(value[k] - centre), variance, len(others) - 1


def _ewma(value: Array, u: Array, base: int | None) -> _Candidate | None:
    """The exponentially weighted mean of the runs' normal scores, where it is farthest from 0.

    Each run is standardised by all runs before it, which makes the scores independent; the first FEWEST_SIDE runs, or
    the baseline period, only serve for that.
    """
    n = len(value)
    first = FEWEST_SIDE if base is None else base
    best: _Candidate | None = None
    mean, variance, began = 0.0, 0.0, first
    for k in range(first, n):
        size, of_size, dof = _standing(value, u, k, np.arange(k))
        p = _p(size, of_size, dof)
        score = float(np.sign(size) * -ndtri(max(p, 1e-300) / 2))
        new = (1 - WEIGHT) * mean + WEIGHT * score
        began = k if new * mean <= 0 else began
        mean = new
        variance = (1 - WEIGHT) ** 2 * variance + WEIGHT**2
        p = float(2 * ndtr(-abs(mean) / np.sqrt(variance)))
        if best is None or p < best.p:
            later = np.arange(began, k + 1)
            shift, of_shift, _ = _difference(value, u, np.arange(began if base is None else base), later)
            best = _Candidate(rule="EWMA", at=began, size=shift, u=float(np.sqrt(of_shift)), p=p)
    return None if best is None else _counted(best, n - first)


def _trend(value: Array, u: Array, base: int | None) -> _Candidate | None:
    """The slope over the runs.  With a baseline period the step and the EWMA show what leaves it."""
    n = len(value)
    if base is not None or n < FEWEST_RUNS + 1:
        return None
    w = 1.0 / u**2
    for _ in range(2):
        k = np.arange(n) - (w * np.arange(n)).sum() / w.sum()
        slope = float((w * k * value).sum() / (w * k**2).sum())
        rest = value - (w * value).sum() / w.sum() - slope * k
        stated = 1.0 / u**2
        # the scatter about the line: n - 2 degrees of freedom
        between = max(0.0, (float((stated * rest**2).sum()) - (n - 2)) / float(stated.sum() * (1 - 2 / n)))
        w = 1.0 / (u**2 + between)
    variance = float(1.0 / (w * k**2).sum())
    u_slope = float(np.sqrt(variance))
    return _Candidate(rule="trend", at=0, size=slope * (n - 1), u=u_slope * (n - 1), p=_p(slope, variance, n - 2))
