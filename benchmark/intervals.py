"""The 95% t-intervals of the reports, over seeds."""

import numpy as np
from scipy import stats


def interval(values: list[float]) -> tuple[float, float]:
    """Mean and half width of its 95% t-interval; nan of a single value."""
    if len(values) < 2:
        return float(np.mean(values)) if values else np.nan, np.nan
    return float(np.mean(values)), float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))


def with_interval(values: list[float], digits: int = 2) -> str:
    """Mean ± half width as text; nothing where there is no value, or one was not measured (nan)."""
    mean, half = interval(values)
    if np.isnan(mean):
        return ""
    return f"{mean:,.{digits}f}" + ("" if np.isnan(half) else f" ± {half:,.{digits}f}")


def paired_difference(first: dict[int, float], second: dict[int, float]) -> str:
    """Difference of the scores of the seeds that both have, with its interval."""
    difference, half = interval([first[seed] - second[seed] for seed in first.keys() & second.keys()])
    return "" if np.isnan(difference) else f"{difference:+.1f}" + ("" if np.isnan(half) else f" ± {half:.1f}")
