"""What `retrieve train` says of a model: its recipe, and the accuracies on held-out objects that led to it."""

from retrieval.console.output import show
from retrieval.model.checkpoint import Checkpoint
from retrieval.report.numbers import interval, percent
from retrieval.report.terminal import print_columns
from retrieval.training.selection import COMPARED

FORCED_ROWS = 3
"""Rows of a table with one recipe: the recipe, the choice and the control."""


def print_comparison(checkpoint: Checkpoint) -> None:
    """Print the accuracies that a checkpoint of `retrieval.train` stores, and sentences on them."""
    provenance = checkpoint.provenance
    table = provenance[COMPARED]
    rows = [[name, interval(*row[:3]), percent(row[3])] for name, row in table["rows"].items()]
    print_columns(table["gallery"], ("one touch", "top-1 accuracy, %", "chance, %"), rows, words=(0,))
    show(f"Measured with {table['touches']} touches of {table['objects']} objects; {table['gallery']}.")
    if recipe := provenance.get("recipe"):
        reason = ": of those compared, it identifies the most touches" * (len(table["rows"]) > FORCED_ROWS)
        show(f"{checkpoint.path} is made by the recipe {recipe}{reason}.")
    else:
        show(f"{checkpoint.path} compares touches with touches.")
    gain, low, high = table["gain"]
    difference = f"{100 * gain:+.1f} points [{100 * low:+.1f}, {100 * high:+.1f}] against touches of 8 x 6 pixels"
    if low > 0:
        show(f"{difference}: more than a linear fit makes of light and coarse shape.")
    else:
        show(f"{difference}: no evidence that the model uses touch. Record more objects.")
    if not table["across_sessions"]:
        show("Within one session drift of light and gel can help: record the objects in another session to exclude it.")
