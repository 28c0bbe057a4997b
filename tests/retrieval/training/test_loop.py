"""The training loop: learning rates, validation, the best step, the state file."""

import math
from itertools import pairwise

import pytest
import torch

from retrieval.errors import NumericalError
from retrieval.model.config import SCHEDULES
from retrieval.training.loop import RATE, Plan, StateFile, train_loop


def one_weight():
    return torch.nn.ParameterList([torch.nn.Parameter(torch.zeros(1))])


def descend(plan, loss=None, module=None, **options):
    """Train one weight from 0 on a slope of 1; return the weight after each step, and the result of the loop."""
    module = module or one_weight()
    optimizer, weights = torch.optim.Adam(module.parameters()), []
    optimizer.register_step_post_hook(lambda *_: weights.append(module[0].item()))
    loss = loss or (lambda step, _: module[0].sum())
    return weights, train_loop(module, optimizer, plan, lambda steps: steps, loss, title="fit", **options)


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        ("constant", [1, 1, 1, 1]),
        ("cosine", [1, (1 + math.sqrt(0.5)) / 2, 0.5, (1 - math.sqrt(0.5)) / 2]),
        ("halving", [1, 0.5, 0.25, 0.125]),
    ],
)
def test_each_step_has_the_learning_rate_of_its_schedule_and_group(schedule, factors):
    weight, other = (torch.nn.Parameter(torch.zeros(1)) for _ in range(2))
    optimizer, weights = torch.optim.SGD([{"params": [weight]}, {"params": [other], RATE: 0.5}]), [0.0]
    optimizer.register_step_post_hook(lambda *_: weights.append(weight.item()))
    module = torch.nn.ParameterList([weight, other])
    loss = lambda step, _: weight.sum() + other.sum()  # noqa: E731
    best = train_loop(module, optimizer, Plan(4, 0.1, schedule), lambda steps: steps, loss, title="fit")
    changes = [before - after for before, after in pairwise(weights)]
    assert changes == pytest.approx([0.1 * factor for factor in factors], rel=1e-5)
    assert other.item() == pytest.approx(weight.item() / 2)
    assert (best.step, best.metrics) == (4, {})
    assert {name: factor(0, 7) for name, factor in SCHEDULES.items()} == dict.fromkeys(SCHEDULES, 1.0)


def test_a_loss_that_is_not_finite_stops_before_the_step_and_names_the_remedy():
    module = one_weight()
    with pytest.raises(NumericalError, match=r"step 0, gave inf; lower learning_rate"):
        descend(Plan(2, 0.1), lambda *_: module[0].sum() + math.inf, module)
    assert module[0].item() == 0


def test_the_weights_of_the_best_step_are_restored_not_the_last():
    """Validation precedes the first step and follows every second one and the last; among equals the first is best."""
    module = one_weight()
    scores, validated = iter([0.2, 0.6, 0.9, 0.9, 0.3]), []

    def validate():
        validated.append(module[0].item())
        return {"score": next(scores), "other": 1.0 - len(validated)}

    weights, best = descend(Plan(7, 0.1, validate_every=2), module=module, validate=validate)
    assert validated == [0, weights[1], weights[3], weights[5], weights[6]]
    assert (best.step, best.metrics) == (4, {"score": 0.9, "other": -2.0})
    assert module[0].item() == validated[2] != validated[4]


def test_a_run_keeps_the_weights_that_it_starts_from_if_no_step_is_better():
    module, scores = one_weight(), iter([0.9, 0.6, 0.8])
    best = descend(Plan(2, 0.1), module=module, validate=lambda: {"score": next(scores)})[1]
    assert (best.step, best.metrics, module[0].item()) == (0, {"score": 0.9}, 0)


def test_without_validation_objects_the_last_step_is_the_model():
    module = one_weight()
    weights, best = descend(Plan(2, 0.1), module=module, validate=dict)
    assert (best.step, module[0].item()) == (2, weights[-1])
    assert weights[-1] != 0


def run(path, at=None, validations=4, **identity):
    """Train, with a power cut in step `at`; the last `validations` of four validations are left."""
    module = one_weight()
    scores = iter([0.2, 0.6, 0.9, 0.1][4 - validations :])
    weights, best = descend(
        Plan(6, 0.1, validate_every=2),
        lambda step, _: (1 / 0 if step == at else 1) * module[0].square().sum() - module[0].sum(),
        module,
        validate=lambda: {"score": next(scores)},
        state=StateFile(path, identity),
    )
    return weights, best, module[0].item()


def test_a_run_continues_from_its_state_with_the_bits_of_an_uninterrupted_run(tmp_path):
    """The best step may lie before the cut: its weights are in the state."""
    weights, best, last = run(tmp_path / "whole.safetensors")
    path = tmp_path / "cut.safetensors"
    with pytest.raises(ZeroDivisionError):
        run(path, at=5)
    assert run(path, validations=1) == (weights[4:], best, last)
    assert best.step == 4
    assert run(path) == ([], best, last)  # a finished run makes no step


def test_a_replaceable_state_of_another_run_is_replaced(tmp_path):
    path = tmp_path / "s.safetensors"
    with pytest.raises(ZeroDivisionError):
        run(path, at=5, config={"seed": 0})
    replaceable = StateFile(path, {"config": {"seed": 1}}, is_replaceable=True)
    assert len(descend(Plan(6, 0.1), state=replaceable)[0]) == 6


def test_a_callback_gets_loss_and_learning_rate_of_each_step_and_the_metrics_of_each_validation():
    told = []
    descend(
        Plan(3, 0.1, "constant", validate_every=2),
        validate=lambda: {"score": 0.5},
        on_step=lambda step, values: told.append((step, {name: round(value, 6) for name, value in values.items()})),
    )
    rate, score = {"learning_rate": 0.1}, {"score": 0.5}
    assert told == [
        (0, score),
        (1, {"loss": 0.0} | rate),
        (2, {"loss": -0.1} | rate | score),
        (3, {"loss": -0.2} | rate | score),
    ]
