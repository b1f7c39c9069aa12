"""Results as a reader sees them, in the terminal and on pages: here numbers and lists."""

from collections.abc import Sequence
import math

MAX_LISTED = 5  # items of a list


def with_error(value: float, error: float, unit: str = '') -> str:
    """
    Return a value to the decimal place of its standard error's second figure, the error, the unit.

    With an infinite error the value is meaningless, and not shown.
    """
    if math.isinf(error):
        return 'not identifiable'
    if not (math.isfinite(error) and error > 0.0 and math.isfinite(value)):
        return f'{value:.5g} {unit}'.rstrip()
    value_text, error_text = column([value, error], error)
    return f'{value_text} ± {error_text} {unit}'.rstrip()


def column(values: Sequence[float], error: float | None = None) -> list[str]:
    """
    Return numbers with the same decimals: as many as show two figures of an error.

    Without one, of the smallest number that is not below a hundredth of the largest.
    """
    sizes = [abs(value) for value in values if math.isfinite(value) and value]
    least = error or min((size for size in sizes if size >= 0.01 * max(sizes)), default=1.0)
    decimals = max(0, 1 - math.floor(math.log10(least)))
    return [f'{value:z.{decimals}f}' for value in values]


def formatted(
    value: float | None, form: str = '.3g', unit: str = '', factor: float = 1.0,
    unknown: str = '-',
) -> str:
    """Return a number times a factor with its unit, or a dash where it is not known."""
    if value is None or not math.isfinite(value):
        return unknown
    return f'{factor * value:{form}} {unit}'.rstrip()


def percent(ratio: float, decimals: int = 2) -> str:
    """Return a ratio in percent, or a dash if nothing moved."""
    return formatted(ratio, f'.{decimals}f', '%', 100.0)


def listed(items: Sequence[str]) -> str:
    """Return items as in a sentence; of many the first ones and how many more."""
    if len(items) > MAX_LISTED:
        return f'{", ".join(items[:MAX_LISTED])} and {len(items) - MAX_LISTED} more'
    return ' and '.join(filter(None, [', '.join(items[:-1]), items[-1]]))


def many(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f'{count} {noun}{"" if count == 1 else "s"}'
