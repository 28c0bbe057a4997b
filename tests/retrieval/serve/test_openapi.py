"""The service conforms to /openapi.json: schemathesis sends allowed and forbidden requests."""

from collections import Counter

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.specs.openapi import checks

from tests.serving import listening, with_history

CHECKS = (checks.status_code_conformance, checks.content_type_conformance, checks.response_schema_conformance)


@pytest.fixture(scope="module")
def service_with_everything(index, tmp_path_factory):
    with with_history(index, tmp_path_factory.mktemp("history"), serve=listening) as (url, _):
        yield schemathesis.openapi.from_url(f"{url}/openapi.json")


@pytest.mark.slow
@pytest.mark.parametrize("mode", list(GenerationMode), ids=lambda mode: mode.name.lower())
def test_all_responses_conform_to_the_openapi_document(service_with_everything, mode):
    wrong, statuses = {}, Counter()
    for found in service_with_everything.get_all_operations():
        operation = found.ok()

        @given(operation.as_strategy(generation_mode=mode))
        @settings(max_examples=15, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        def ask(case):
            response = case.call(timeout=60)
            statuses[response.status_code] += 1
            assert response.status_code != 500, response.text
            case.validate_response(response, checks=CHECKS)

        try:
            ask()
        except Unsatisfiable:
            continue  # a path without parameters has no invalid requests
        except Exception as error:
            wrong[operation.label] = str(error)
    assert not wrong
    assert sum(statuses.values()) > 100
    expected = {200, 404, 422} if mode is GenerationMode.POSITIVE else {404, 422}
    assert expected <= set(statuses), statuses
