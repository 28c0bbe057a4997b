"""Response documents of the service, as OpenAPI describes them.

`QueryResult.to_dict` (`retrieval.search.query.answer`) makes the answer to a query, which is sent unchanged. OpenAPI
reads its dataclasses. The models here describe the remaining fields, and a test compares both.
"""

from typing import Any

from pydantic import BaseModel, Field

from retrieval.model.verification import DecisionBounds
from retrieval.search.query.answer import NearestReference


class MatchDocument(BaseModel):
    """One object of a ranking, with the id of its best photo.

    probability_if_present: probability given that the catalogue contains the object. reference: only if the catalogue
    contains touches of the object.
    """

    rank: int
    object_id: str
    logit: float
    probability: float | None
    probability_if_present: float | None
    photo: str
    metadata: dict[str, Any]
    reference: NearestReference | None = None


class QueryDocument(BaseModel):
    """The document of `retrieve query --json`.

    unlisted_probability: total probability of the objects that `results` does not list. more_grasps: number of further
    grasps after which the verdict is expected to be "match"; null for other verdicts than "none of these", and if more
    grasps do not help. advice: a sentence on how to get a clearer answer.
    """

    query: dict[str, Any]
    index: dict[str, Any]
    timing_ms: dict[str, float]
    verdict: str
    none_probability: float | None
    unlisted_probability: float | None
    more_grasps: int | None
    advice: str | None
    posterior: dict[str, Any] | None
    results: list[MatchDocument]


class PhotoDocument(BaseModel):
    """A photo of the catalogue. All routes use its `id`. metadata: the user's own."""

    id: str = Field(examples=["mug/1.jpg"])
    object_id: str = Field(examples=["mug"])
    metadata: dict[str, Any] = Field(examples=[{"material": "glazed clay"}])


class CatalogueDocument(BaseModel):
    """One page of photos. total: number of matching photos; next: offset of the next page, null at the end."""

    generation: str = Field(examples=["gen-000007"])
    total: int
    offset: int
    next: int | None
    items: list[PhotoDocument]


class VerificationDocument(BaseModel):
    """The document of `retrieve verify --json`.

    decision: "accept", "reject", "another grasp", "no contact" or "not a gel image"; bounds is null for the last two.
    """

    expected: str = Field(examples=["mug"])
    decision: str = Field(examples=["accept"])
    touches: list[list[str]]
    grasps: list[str]
    log_ratios: list[float]
    bounds: DecisionBounds | None


class IndexDocument(BaseModel):
    """Description of the index, its model and the service.

    sensors: names of live sensors; can_grasp, can_verify: whether POST /v1/grasp and POST /v1/verify work;
    stores_history: whether queries and feedback are stored; trials: number of unseen objects for the human baseline.
    """

    generation: str
    kind: str
    photos: int
    objects: int
    model: str
    trained_on: str
    encoder: str
    fingers: int
    background: str
    calibrated: bool
    candidates: int | None
    sensors: list[str]
    can_grasp: bool
    can_verify: bool
    stores_history: bool
    trials: int
    version: str


class GraspDocument(BaseModel):
    """Gel images of one grasp of the simulated rig, as PNG files in base64, and the grasped object."""

    object_id: str
    touches: list[str]
    background: list[str] | None
