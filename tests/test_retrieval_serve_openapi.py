"""What /openapi.json says is what the service does: schemathesis asks what the document allows, and what not."""

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.specs.openapi import checks

from retrieval.serve.errors import KINDS
from robot.recording.folder import RecordingWriter
from tests.serving import listening, service

schema = schemathesis.pytest.from_fixture("document")


@pytest.fixture(scope="module")
def document(index, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept")
    with (
        RecordingWriter(folder / "recording", {"source": "said", "sensor": "drawn"}) as writer,
        listening(index, None, writer, history=folder) as (url, _),
    ):
        yield schemathesis.openapi.from_url(f"{url}/openapi.json").exclude(path_regex="stream$")


@pytest.fixture(scope="module")
def told(index):
    with service(index) as client:
        return client.get("/openapi.json").json()


def test_every_body_has_an_example_and_every_reference_leads_somewhere(told):
    bodies = [
        body["schema"]
        for path in told["paths"].values()
        for operation in path.values()
        for body in operation.get("requestBody", {}).get("content", {}).values()
    ]
    assert len(bodies) > 6
    names = set(told["components"]["schemas"])
    text = str(told)
    referred = {part.split("'")[0] for part in text.split("#/components/schemas/")[1:]}
    assert referred <= names
    for name in ("QueryBody", "BatchBody", "QueryDocument"):
        assert told["components"]["schemas"][name]["examples"]


def test_every_problem_that_a_path_names_is_a_problem_document(told):
    statuses = {status for status, _ in KINDS.values()}
    for path in told["paths"].values():
        for operation in path.values():
            for status, response in operation["responses"].items():
                if int(status) >= 400 and int(status) in statuses:
                    assert "application/problem+json" in response["content"], (path, status)


@pytest.mark.slow
@schema.parametrize()
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
def test_whatever_is_sent_the_answer_is_one_that_the_document_names(case):
    response = case.call(timeout=60)
    assert response.status_code != 500, response.text
    case.validate_response(
        response,
        checks=(
            checks.status_code_conformance,
            checks.content_type_conformance,
            checks.response_schema_conformance,
        ),
    )
