"""Identify objects by touch: from the gel images of a grasp, find the catalogue photo of the object in the hand.

Public names are imported on first use, so `import retrieval` is fast. Each layer imports only the layers before it:

    errors, version, console, metrics -> data -> model -> training -> indexing -> search -> cluster -> methods
    -> evaluation -> report -> frontier, serve -> commands

>>> import retrieval
>>> with retrieval.open("index") as searcher:
...     answer = searcher.query(["a.png", "b.png"])
>>> answer.top.object_id in ("mug", "tin")
True
"""

from typing import TYPE_CHECKING

from _touch_retrieval.lazy import lazy_names

if TYPE_CHECKING:
    from retrieval.console.progress import show_progress as show_progress
    from retrieval.data.check.recording import check_recording as check_recording
    from retrieval.data.dataset import load_grasps as load_grasps
    from retrieval.data.dataset import make_split as make_split
    from retrieval.errors import BadInput as BadInput
    from retrieval.errors import RetrievalError as RetrievalError
    from retrieval.evaluation.evaluate import evaluate as evaluate
    from retrieval.evaluation.protocol import Protocol as Protocol
    from retrieval.frontier.measure import measure_frontier as measure_frontier
    from retrieval.indexing.build import build_index as build_index
    from retrieval.indexing.enrolled import remove_enrolled as remove_enrolled
    from retrieval.indexing.report import BuildReport as BuildReport
    from retrieval.methods.method import Method as Method
    from retrieval.methods.method import MethodSettings as MethodSettings
    from retrieval.model.checkpoint import Checkpoint as Checkpoint
    from retrieval.model.checkpoint import load_checkpoint as load_checkpoint
    from retrieval.model.config import Config as Config
    from retrieval.model.config import load_config as load_config
    from retrieval.model.encode import encode_photos as encode_photos
    from retrieval.model.encode import encode_touches as encode_touches
    from retrieval.model.losses.loss import Loss as Loss
    from retrieval.model.shipped import shipped_model as shipped_model
    from retrieval.model.touch_reader import EncodedTouches as EncodedTouches
    from retrieval.model.towers.tower import Tower as Tower
    from retrieval.report.evaluation import write_report as write_report
    from retrieval.search.answer import Enrolment as Enrolment
    from retrieval.search.answer import Match as Match
    from retrieval.search.answer import QueryResult as QueryResult
    from retrieval.search.answer import Verification as Verification
    from retrieval.search.searcher import Searcher as Searcher
    from retrieval.serve.client import Client as Client
    from retrieval.training.recipes.recipe import Recipe as Recipe
    from retrieval.training.train import train as train

    open = Searcher.open

_MODULES = {
    "BadInput": "errors:BadInput",
    "BuildReport": "indexing.report:BuildReport",
    "Checkpoint": "model.checkpoint:Checkpoint",
    "Client": "serve.client:Client",
    "Config": "model.config:Config",
    "Enrolment": "search.answer:Enrolment",
    "EncodedTouches": "model.touch_reader:EncodedTouches",
    "Loss": "model.losses.loss:Loss",
    "Match": "search.answer:Match",
    "Method": "methods.method:Method",
    "Protocol": "evaluation.protocol:Protocol",
    "QueryResult": "search.answer:QueryResult",
    "Recipe": "training.recipes.recipe:Recipe",
    "RetrievalError": "errors:RetrievalError",
    "Searcher": "search.searcher:Searcher",
    "MethodSettings": "methods.method:MethodSettings",
    "Tower": "model.towers.tower:Tower",
    "Verification": "search.answer:Verification",
    "build_index": "indexing.build:build_index",
    "check_recording": "data.check.recording:check_recording",
    "encode_photos": "model.encode:encode_photos",
    "encode_touches": "model.encode:encode_touches",
    "evaluate": "evaluation.evaluate:evaluate",
    "load_checkpoint": "model.checkpoint:load_checkpoint",
    "load_config": "model.config:load_config",
    "load_grasps": "data.dataset:load_grasps",
    "make_split": "data.dataset:make_split",
    "measure_frontier": "frontier.measure:measure_frontier",
    "open": "search.searcher:Searcher.open",
    "remove_enrolled": "indexing.enrolled:remove_enrolled",
    "shipped_model": "model.shipped:shipped_model",
    "show_progress": "console.progress:show_progress",
    "train": "training.train:train",
    "write_report": "report.evaluation:write_report",
}
"""Module and attribute of each public name."""

__all__ = list(_MODULES)

if not TYPE_CHECKING:  # with __getattr__, a type checker accepts every attribute name
    __getattr__, __dir__ = lazy_names(__name__, _MODULES)
