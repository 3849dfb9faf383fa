"""The result of an experiment: metrics with their limits, and result.json (docs/architecture.md, "Experiments").

``metrics`` is a flat map from name to number.  A rate comes with its Wilson 95 % interval as ``NAME_low`` and
``NAME_high``.  ``limits`` holds [least, most] (null: no limit) and ``missed`` the names outside theirs.  A clocked
metric that misses its limit on a noisy host is ``inconclusive`` instead, because noise only slows a run down.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = ("numpy", "numba", "pybullet")
Z_95: Final = 1.959963984540054
FIRST_SEALED: Final = 100_000
SEALED_SEEDS: Final = 900_000
"""Sealed seeds are these many from the first; tuning and validation use smaller ones."""
PRINTED: Final = {
    "%": ("", 100.0),
    "mm": ("m", 1e3),
    "cm": ("m", 100.0),
    "deg": ("rad", math.degrees(1.0)),
    "MPa": ("pa", 1e-6),
    "min": ("s", 1 / 60),
}
"""Printed units: the SI unit in a metric's name, and the factor from there."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric: its key in ``metrics``, title, printed unit, how it is measured (empty: the title says it), limits
    (None: only reported).

    ``scale`` converts the number into the printed unit; None: from the SI unit in its name, a share into per cent.
    ``clocked``: the number depends on the host's speed.
    """

    name: str
    title: str
    unit: str
    how: str = ""
    least: float | None = None
    most: float | None = None
    scale: float | None = None
    clocked: bool = False

    @property
    def factor(self) -> float:
        """The printed number over that in ``metrics``."""
        si_unit, factor = PRINTED.get(self.unit, ("", 1.0))
        named = self.unit == "%" or si_unit in re.split(r"[_.]", self.name)
        return self.scale if self.scale is not None else factor if named else 1.0

    def holds(self, value: float) -> bool:
        """Tell whether a value is finite and within the limits."""
        low = self.least is None or value >= self.least
        high = self.most is None or value <= self.most
        return math.isfinite(value) and low and high

    def limit_text(self) -> str:
        """Write the limit in the printed unit."""
        low, high = (None if v is None else _digits(v * self.factor) for v in (self.least, self.most))
        if low and high:
            return f"{low} to {high}" if low != high else f"exactly {low}"
        return f"at least {low}" if low else f"at most {high}" if high else ""

    def text(self, value: float) -> str:
        """Write the value in the printed unit."""
        return f"{_digits(value * self.factor)}{' ' if self.unit and self.unit != '%' else ''}{self.unit}"


def _digits(value: float) -> str:
    """Write four significant digits; a large whole number in full."""
    return f"{value:.0f}" if value >= 1e4 and value.is_integer() else f"{value:.4g}"


@dataclass(frozen=True, slots=True)
class Result:
    """The content of result.json."""

    experiment: str
    commit: str
    profile: str
    seed: int
    trials: int
    metrics: dict[str, float]
    paper: dict[str, float]
    environment: dict[str, str]
    limits: dict[str, tuple[float | None, float | None]] = field(default_factory=dict)
    missed: tuple[str, ...] = ()
    inconclusive: tuple[str, ...] = ()

    @property
    def unmeasured(self) -> tuple[str, ...]:
        """The limits to which there is no figure."""
        return tuple(n for n in self.limits if n not in self.metrics and n not in self.inconclusive)

    @property
    def met(self) -> int:
        """The number of limits that a figure meets."""
        return len(self.limits) - len({*self.missed, *self.inconclusive, *self.unmeasured})

    def as_judged(self, metric: Metric) -> Metric:
        """Give the metric the limits against which this result was evaluated; those of today may differ."""
        least, most = self.limits.get(metric.name, (None, None))
        return replace(metric, least=least, most=most)

    def interval_text(self, metric: Metric) -> str:
        """Write the interval of a rate with its number of trials; empty for other metrics."""
        low, high = (self.metrics.get(f"{metric.name}_{end}") for end in ("low", "high"))
        if low is None or high is None:
            return ""
        n = self.metrics[f"{metric.name}_n"]
        return f" ({low * metric.factor:.1f} to {high * metric.factor:.1f}, n = {n:.0f})"

    def save(self, path: Path) -> None:
        """Write it as JSON with sorted metrics."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.json() + "\n")

    def json(self) -> str:
        """Return result.json as text; a metric without a number is null, and one that never ended is "inf"."""
        document = asdict(self)
        document["metrics"] = {k: _written(v) for k, v in sorted(self.metrics.items())}
        return json.dumps(document, indent=2)


def _written(value: float) -> float | str | None:
    """Write infinity and NaN differently: JSON knows neither, and they say different things."""
    return value if math.isfinite(value) else None if math.isnan(value) else str(value)


def evaluate(
    definitions: Iterable[Metric], metrics: Mapping[str, float], noisy: bool, undecided: Collection[str] = ()
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """List the names of the metrics that miss their limit, and of the inconclusive ones.

    Inconclusive are clocked metrics that miss theirs on a noisy host, and the ``undecided``, whatever their value.
    """
    failed, inconclusive = [], []
    for m in definitions:
        fails = m.name in metrics and not m.holds(metrics[m.name])
        if m.name in undecided or (fails and m.clocked and noisy):
            inconclusive.append(m.name)
        elif fails:
            failed.append(m.name)
    return tuple(failed), tuple(inconclusive)


def make_result(
    experiment: str,
    definitions: Sequence[Metric],
    metrics: dict[str, float],
    *,
    profile: str,
    seed: int,
    trials: int,
    more: Mapping[str, str],
    paper: Mapping[str, float] | None = None,
    noisy: bool = False,
    undecided: Mapping[str, str] | None = None,
) -> Result:
    """Make the result of an experiment, evaluated against its limits; ``more`` is added to the host's environment.

    ``undecided``: metrics that this run cannot decide, with the reason, which is added as ``open: NAME``.
    """
    reasons = dict(undecided or {})
    missed, inconclusive = evaluate(definitions, metrics, noisy, reasons)
    return Result(
        experiment=experiment,
        commit=commit(),
        profile=profile,
        seed=seed,
        trials=trials,
        metrics=metrics,
        paper=dict(paper or {}),
        environment={**environment(), **more, **{f"open: {n}": reasons[n] for n in inconclusive if n in reasons}},
        limits=limits_of(definitions),
        missed=missed,
        inconclusive=inconclusive,
    )


def evaluated(result: Result, definitions: Sequence[Metric], metrics: dict[str, float]) -> Result:
    """Give a saved result other metrics, computed anew from its outcomes, and the limits of today; the rest stays."""
    missed, inconclusive = evaluate(definitions, metrics, noisy=False)
    return replace(result, metrics=metrics, limits=limits_of(definitions), missed=missed, inconclusive=inconclusive)


def limits_of(definitions: Iterable[Metric]) -> dict[str, tuple[float | None, float | None]]:
    """Return (least, most) of every metric that has a limit."""
    return {m.name: (m.least, m.most) for m in definitions if m.least is not None or m.most is not None}


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Compute Wilson's 95 % score interval of a rate; (0, 1) for no trials."""
    if n == 0:
        return 0.0, 1.0
    p, z2 = hits / n, Z_95 * Z_95
    middle = p + z2 / (2 * n)
    half = Z_95 * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    return max(0.0, (middle - half) / (1 + z2 / n)), min(1.0, (middle + half) / (1 + z2 / n))


def rate(name: str, hits: int, n: int) -> dict[str, float]:
    """Return a rate and its interval as metrics."""
    low, high = wilson(hits, n)
    return {name: hits / n if n else math.nan, f"{name}_low": low, f"{name}_high": high, f"{name}_n": float(n)}


def mean(values: Sequence[float]) -> float:
    """Compute the arithmetic mean; NaN without values."""
    return sum(values) / len(values) if values else math.nan


def commit() -> str:
    """Read the short hash of the checkout; ``+changes``: tracked files beside docs/ differ; ``unknown`` outside git."""
    try:
        head = _git("rev-parse", "--short=12", "HEAD")
        return head + ("+changes" if _git("status", "--porcelain", "--untracked-files=no", ":(exclude)docs") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def environment() -> dict[str, str]:
    """Describe the host and the packages that measured."""
    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": _processor(),
        "cpus": str(len(os.sched_getaffinity(0))),
        **versions(PACKAGES),
    }


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Read the installed versions of packages; ``missing`` for one that is not installed."""
    installed = {}
    for name in packages:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            installed[name] = "missing"
    return installed


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def sealed_seed(commit: str, experiment: str) -> int:
    """Draw the seed of an experiment from the commit that is measured, so that nobody can have tuned on it.

    The rule is part of the commit, and its hash is not known before the commit is made: each change of the code brings
    other trials, and anyone with the checkout can draw the same.
    """
    digest = hashlib.sha256(f"{commit}/{experiment}".encode()).digest()
    return FIRST_SEALED + int.from_bytes(digest[:8], "big") % SEALED_SEEDS
