"""Methods to compare: each says how well a touch and a photo go together, fitted on the same grasps.

A new method is one file, one row of `METHODS` and nothing else: the behaviour suite runs over the table.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.methods.base import Method, Setting

METHODS = {
    "late_fusion": "retrieval.methods.late_fusion:LateFusion",
    "set_fusion": "retrieval.methods.set_fusion:SetFusion",
    "prune_rerank": "retrieval.methods.prune_rerank:PruneRerank",
    "contrastive": "retrieval.methods.contrastive:Contrastive",
    "contrastive_sigmoid": "retrieval.methods.contrastive:ContrastiveSigmoid",
    "cca": "retrieval.methods.cca:Cca",
    "cca_pca": "retrieval.methods.cca_pca:CcaPca",
    "cca_towers": "retrieval.methods.cca_towers:CcaTowers",
    "plsca": "retrieval.methods.plsca:Plsca",
    "chance": "retrieval.methods.chance:Chance",
    "constant": "retrieval.methods.constant:Constant",
}

KNOW_NOTHING = frozenset({"chance", "constant"})
"""Methods that do not look at their input."""


def build_method(name: str, setting: "Setting") -> "Method":
    """Make the method `name`, not fitted yet. Raises ConfigError for an unknown name."""
    require_known(name)
    module, cls = METHODS[name].split(":")
    method: Method = getattr(import_module(module), cls)(setting)
    return method


def require_known(*names: str) -> None:
    """Raise ConfigError for a name that no method has."""
    for name in names:
        if name not in METHODS:
            raise ConfigError(f"method must be one of {', '.join(METHODS)}; got {name!r}")
