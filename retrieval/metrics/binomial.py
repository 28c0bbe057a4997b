"""Exact intervals of a share that was counted."""

from scipy.special import betaincinv

from retrieval.errors import BadInput


def binomial_interval(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934): never too narrow for independent trials."""
    if not 0 <= successes <= trials or trials < 1:
        raise BadInput(f"successes must lie within 0..trials, and trials be at least 1; got {successes} of {trials}")
    return clopper_pearson(successes, trials, level)


def clopper_pearson(successes: float, trials: float, level: float) -> tuple[float, float]:
    """The interval of `binomial_interval`, for numbers that need not be whole."""
    tail = (1 - level) / 2
    low = betaincinv(successes, trials - successes + 1, tail) if successes else 0.0
    high = betaincinv(successes + 1, trials - successes, 1 - tail) if successes < trials else 1.0
    return float(low), float(high)
