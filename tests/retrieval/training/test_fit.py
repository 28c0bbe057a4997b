"""The training loop: learning rates, validation, early stops, and the best step."""

import math

import pytest
import torch

from retrieval.console.progress import Bar
from retrieval.errors import NumericalError
from retrieval.model.config import SCHEDULES
from retrieval.training.fit import Plan, fit, fit_best


def descend(plan, batches=None, loss=None, **options):
    """Fit one weight from 0 on a slope of 1; return the weight after each step, and the result of `fit`."""
    weight, weights = torch.nn.Parameter(torch.zeros(1)), []
    optimizer = torch.optim.SGD([weight])
    with Bar("fit", plan.steps, "steps", quiet=True) as bar:
        done = fit(
            optimizer,
            plan,
            range(plan.steps) if batches is None else batches,
            loss or (lambda _: weight.sum()),
            bar=bar,
            after_step=lambda _: weights.append(weight.item()),
            **options,
        )
    return weights, done


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        ("constant", [1, 1, 1, 1]),
        ("cosine", [1, (1 + math.sqrt(0.5)) / 2, 0.5, (1 - math.sqrt(0.5)) / 2]),
        ("halving", [1, 0.5, 0.25, 0.125]),
    ],
)
def test_each_step_has_the_learning_rate_of_its_schedule(schedule, factors):
    weights, done = descend(Plan(4, 0.1, schedule))
    changes = [-after + before for before, after in zip([0.0, *weights], weights, strict=False)]
    assert changes == pytest.approx([0.1 * factor for factor in factors], rel=1e-5)
    assert done == 4


def test_every_schedule_starts_at_the_full_rate():
    assert {name: factor(0, 7) for name, factor in SCHEDULES.items()} == dict.fromkeys(SCHEDULES, 1.0)


def test_validation_follows_every_validate_every_steps_and_the_last_step():
    validated = []
    descend(Plan(7, 0.1, validate_every=3), validate=validated.append)
    assert validated == [3, 6, 7]


def test_a_stop_ends_after_the_current_step_which_is_validated():
    validated, stops = [], iter([False, True])
    weights, done = descend(Plan(9, 0.1, validate_every=5), validate=validated.append, should_stop=lambda: next(stops))
    assert (len(weights), done, validated) == (2, 2, [2])


def test_a_resumed_run_has_the_rates_and_validations_of_an_uninterrupted_run():
    validated = []
    whole, _ = descend(Plan(6, 0.1, validate_every=2))
    rest, done = descend(Plan(6, 0.1, validate_every=2), range(3, 6), done=3, validate=validated.append)
    assert rest == pytest.approx([after - whole[2] for after in whole[3:]], abs=1e-6)
    assert (done, validated) == (6, [4, 6])


def test_a_loss_that_is_not_finite_stops_the_fit_before_the_step():
    notes = []
    with pytest.raises(NumericalError, match=r"loss must stay finite; fit, step 0, gave inf; lower learning_rate"):
        descend(Plan(2, 0.1), loss=lambda _: torch.tensor(math.inf, requires_grad=True), note=lambda: notes.append(1))
    assert notes == []


def test_gradients_exist_before_the_step_and_are_cleared_before_the_next():
    weight, gradients = torch.nn.Parameter(torch.zeros(1)), []
    with Bar("fit", 2, "steps", quiet=True) as bar:
        optimizer = torch.optim.SGD([weight])
        fit(
            optimizer,
            Plan(2, 0.1, "constant"),
            [1.0, 5.0],
            lambda slope: slope * weight.sum(),
            bar=bar,
            before_step=lambda: gradients.append(weight.grad.item()),
        )
    assert gradients == [1.0, 5.0]
    assert weight.item() == pytest.approx(-0.6)


# The best step ---------------------------------------------------------------------------------------------


def best_of(module, plan, loss, score, **options):
    with Bar("fit", plan.steps, "steps", quiet=True) as bar:
        return fit_best(module, plan, loss, score, bar=bar, **options)


def test_the_weights_of_the_best_step_are_restored_not_the_last():
    """The score falls after step 4: the weights of that step must be restored, in evaluation mode."""
    weight = torch.nn.Linear(1, 1, bias=False)
    scores, weights, modes = iter([0.6, 0.9, 0.9, 0.3]), [], []

    def loss(_):
        modes.append(weight.training)
        return weight.weight.sum()

    def score():
        modes.append(weight.training)
        weights.append(weight.weight.item())
        return next(scores)

    best = best_of(weight, Plan(8, 0.1, validate_every=2), loss, score)
    assert (best.step, best.value) == (4, 0.9)
    assert weight.weight.item() == weights[1] != weights[3]
    assert modes == [True, True, False] * 4
    assert not weight.training


def test_only_matrices_decay():
    layer = torch.nn.Linear(2, 2)
    before = layer.weight.detach().clone(), layer.bias.detach().clone()
    best_of(layer, Plan(1, 0.1), lambda _: (0 * layer(torch.ones(1, 2))).sum(), lambda: 0.0, weight_decay=1.0)
    assert torch.allclose(layer.weight, 0.9 * before[0])
    assert torch.equal(layer.bias, before[1])
