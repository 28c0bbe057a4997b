"""What the design saves, as ratios measured in one run: `python -m tests.benchmarks`.

No time is asserted anywhere; the arms of a ratio take turns, so that a busy machine slows all of them.
"""
