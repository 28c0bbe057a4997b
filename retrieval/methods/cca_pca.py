"""CCA on the widest directions of each side: for few objects.

A few dozen objects do not say which of a thousand features correlate across touch and photo: the ridge of `Cca` damps
the thin directions, this leaves them out. On 36 everyday objects of VT60 it is no better than `Cca` (docs/real.md), and
takes less time, which is why the controls of the benchmark of real data stand on it.
"""

from retrieval.methods.cca import Cca


class CcaPca(Cca):
    """`Cca` after principal components, as many as `most_directions` of touch and of photo."""

    most_directions = 96
