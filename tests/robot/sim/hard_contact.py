"""Stiff and extreme inputs of contact and closing."""

import itertools
import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from benchmarks.frontier.closed_forms import hertz
from robot.sim.contact.constrained_cg import ContactProblem
from robot.sim.contact.kernels import Floats, Operator, influence, layer_compliance, layer_symbol, love_patch
from robot.sim.contact.layer import Contact, Layer, press
from tests.hard_case import HardCase
from tests.robot.sim.closing_jaws import Motion, close, spring

_CONTACT, _KERNEL, _CLOSING = "contact solver", "layer kernel", "gripper closing"


def hard_cases() -> Iterator[HardCase]:
    """Yield cases of contact and closing, in about ten seconds."""
    yield _overflow()
    yield _cancellation()
    yield _mean_displacement()
    yield _far_patch()
    yield _one_pixel()
    yield _pin_in_a_plate()
    yield _wrap_around()
    yield _no_object()
    yield _every_scale()
    yield _every_shape()
    yield _stiff_closing()


def naive_symbol(x: Floats, poisson: float) -> Floats:
    """S as printed: overflows for a thick layer, cancels for a thin incompressible one."""
    k = 3.0 - 4.0 * poisson
    rest = 2.0 * x * x + 5.0 - 12.0 * poisson + 8.0 * poisson**2
    return np.asarray((k * np.sinh(2.0 * x) - 2.0 * x) / (k * np.cosh(2.0 * x) + rest))


def naive_patch(x: float, y: float) -> float:
    """Love's formula at any (x, y): one logarithm's argument cancels to 0 far on the negative side."""
    left, right, up, down = x - 0.5, x + 0.5, y - 0.5, y + 0.5
    far_far, far_near = np.hypot(down, right), np.hypot(down, left)
    near_far, near_near = np.hypot(up, right), np.hypot(up, left)
    total = right * np.log((down + far_far) / (up + near_far)) + down * np.log((right + far_far) / (left + far_near))
    total += left * np.log((up + near_near) / (down + far_near)) + up * np.log((left + near_near) / (right + near_far))
    return float(total / np.pi)


def naive_solve(operator: Operator, gap: Floats, load: float, max_iterations: int = 300) -> tuple[Floats, int]:
    """Polonsky & Keer's iteration to 1e-6 without a safeguard: 0/0 for one pixel, and it may cycle."""
    pressure, direction, old, conjugate = np.full(gap.shape, load / gap.size), np.zeros(gap.shape), 1.0, 0.0
    for iteration in range(max_iterations):
        contact = pressure > 0.0
        distance = operator(pressure) + gap
        distance = distance - distance[contact].mean()
        squares = float((distance[contact] ** 2).sum())
        direction = np.where(contact, distance + conjugate * squares / old * direction, 0.0)
        old = squares
        moved = operator(direction)
        moved = moved - moved[contact].mean()
        length = (distance * direction)[contact].sum() / (moved * direction)[contact].sum()
        new = np.maximum(pressure - length * direction, 0.0)
        entering = (new <= 0.0) & (distance < 0.0)
        new[entering] -= length * distance[entering]
        conjugate = 0.0 if entering.any() else 1.0
        new *= load / new.sum()
        if not np.abs(new - pressure).sum() > 1e-6 * load:
            return new, iteration + 1
        pressure = new
    return pressure, max_iterations


def _overflow() -> HardCase:
    x = np.array([1000.0])
    naive, ours = float(naive_symbol(x, 0.48)[0]), float(layer_symbol(x, 0.48)[0])
    return HardCase(
        _KERNEL, "S(x) at x = qh = 1000", "1, the half-space", f"{naive}", f"{ours}", ours == 1.0, naive == 1.0
    )


def _cancellation() -> HardCase:
    x, exact = np.array([1e-8]), 2.0 / 3.0 * 1e-24
    naive, ours = float(naive_symbol(x, 0.5)[0]), float(layer_symbol(x, 0.5)[0])
    expected, near = f"2 x^3/3 = {exact:.6g}", [math.isclose(value, exact) for value in (naive, ours)]
    return HardCase(_KERNEL, "S(x) at x = 1e-8, nu = .5", expected, f"{naive:.6g}", f"{ours:.6g}", near[1], near[0])


def _mean_displacement() -> HardCase:
    """An incompressible layer keeps its volume: uniform pressure does not displace it."""
    with np.errstate(invalid="ignore"):
        naive = float((2.0 * naive_symbol(np.zeros(1), 0.5) / np.zeros(1))[0])
    ours = float(layer_compliance(np.zeros(1), 2.0, 0.5)[0])
    return HardCase(_KERNEL, "2 S(qh)/q at q = 0, nu = .5", "0", f"{naive}", f"{ours}", ours == 0.0, naive == 0.0)


def _far_patch() -> HardCase:
    far, exact = 10_000, 1.0 / (math.pi * 10_000)
    naive, ours = naive_patch(0.0, -far) / exact - 1.0, float(love_patch((far + 1, 1))[far, 0]) / exact - 1.0
    near = [abs(error) < 1e-8 for error in (naive, ours)]
    case, expected = "Love's patch, 10,000 pixels away", "1/(pi r) to 1e-8"
    return HardCase(_KERNEL, case, expected, f"off by {naive:.1e}", f"{ours:.1e}", near[1], near[0])


_SIDE = 32


def _squares() -> Floats:
    """Return the squared distance (_SIDE, _SIDE) from pixel (_SIDE / 2, _SIDE / 2), in pixels."""
    across = np.arange(_SIDE) - _SIDE // 2
    return np.asarray(across[:, None] ** 2.0 + across**2.0)


_NAIVE_CAP = 300


def _naive(gap: Floats, layer: Layer, force_n: float) -> tuple[str, bool]:
    """Return the outcome of the unsafeguarded iteration for a pixel of 1 mm, and whether it ends in numbers."""
    operator = Operator(influence(gap.shape, layer.thickness_mm, layer.poisson), gap.shape)
    pressure, iterations = naive_solve(operator, gap, force_n / layer.plane_modulus_mpa, _NAIVE_CAP)
    finite = bool(np.isfinite(pressure).all())
    return f"{'finite' if finite else 'NaN'} after {iterations} iterations", finite and iterations < _NAIVE_CAP


def _outcome(contact: Contact) -> str:
    end = "converged" if contact.converged else "not converged"
    return f"{end} after {contact.iterations} iterations, flags {', '.join(contact.flags) or 'none'}"


def is_finite(contact: Contact) -> bool:
    """Return whether all its numbers are finite."""
    numbers = (contact.approach_mm, contact.force_n, contact.area_mm2, contact.residual)
    return bool(np.isfinite(contact.pressure_mpa).all() and np.isfinite(contact.displacement_mm).all()) and all(
        math.isfinite(number) for number in numbers
    )


def _solved(contact: Contact, force_n: float) -> bool:
    return is_finite(contact) and contact.converged and math.isclose(contact.force_n, force_n, rel_tol=1e-9)


def _one_pixel() -> HardCase:
    layer, gap, force = Layer(0.75, 0.5, 2.0), _squares() / 200.0, 1e-4
    contact = press(gap, 1.0, layer, force_n=force, tolerance=1e-6)
    holds = _solved(contact, force) and "unresolved" in contact.flags
    naive, naive_holds = _naive(gap, layer, force)
    case, expected = "ball touching one pixel, nu = .5", "solved, flagged unresolved"
    return HardCase(_CONTACT, case, expected, naive, _outcome(contact), holds, naive_holds)


def _pin_in_a_plate() -> HardCase:
    """The pin takes 0.1 N, then the plate around it takes over."""
    layer, gap, force = Layer(0.75, 0.5), np.full((_SIDE, _SIDE), 0.1), 0.1
    gap[_SIDE // 2, _SIDE // 2] = 0.0
    contact = press(gap, 1.0, layer, force_n=force, tolerance=1e-6)
    expected = "converges: the plate carries part of the force"
    holds = _solved(contact, force) and contact.area_mm2 > 1.0
    naive, naive_holds = _naive(gap, layer, force)
    return HardCase(_CONTACT, "pin of one pixel in a plate", expected, naive, _outcome(contact), holds, naive_holds)


class _PeriodicOperator:
    """Displacement by FFT without padding: the closed form at the wave numbers of the grid, which repeats."""

    rounding = 1e-12

    def __init__(self, side: int) -> None:
        q = 2.0 * np.pi * np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
        self._transform = layer_compliance(q, math.inf, 0.5)
        self.bound, self.peak = float(self._transform.max()), float(np.fft.irfft2(self._transform)[0, 0])

    def __call__(self, pressure: Floats) -> Floats:
        return np.asarray(np.fft.irfft2(np.fft.rfft2(pressure) * self._transform))


def _wrap_around() -> HardCase:
    """A half-space's influence falls like 1/r: on a periodic grid the neighbouring copies have an effect."""
    layer, gap, force = Layer(0.75, 0.5), _squares() / 200.0, 1.0
    depth = hertz(force, 100.0, layer.plane_modulus_mpa)[1]
    problem = ContactProblem(_PeriodicOperator(_SIDE), gap, load=force)
    periodic = problem.solve(problem.initial_pressure(), 1e-3, 1000).approach
    errors = [approach / depth - 1.0 for approach in (periodic, press(gap, 1.0, layer, force_n=force).approach_mm)]
    naive, ours = (f"{100 * error:+.1f} %" for error in errors)
    near = [abs(error) < 0.02 for error in errors]
    return HardCase(_CONTACT, "Hertz without padding", "depth to 2 %", naive, ours, near[1], near[0])


def _no_object() -> HardCase:
    layer, empty = Layer(0.75, 0.5), np.full((_SIDE, _SIDE), np.inf)
    contact, at_rest = press(empty, 1.0, layer, force_n=1.0), press(_squares(), 1.0, layer, force_n=0.0)
    holds = is_finite(contact) and not contact.converged and contact.flags == ("no_contact",)
    holds = holds and at_rest.converged and at_rest.force_n == 0.0
    naive, naive_holds = _naive(empty, layer, 1.0)
    expected = "no pressure, not converged"
    return HardCase(_CONTACT, "no object, 1 N", expected, naive, _outcome(contact), holds, naive_holds)


def _every_scale() -> HardCase:
    """E 1e3 to 1e12 Pa, force 1e-6 to 1e4 N, radius 1e-6 to 1e3 m, on a fixed grid and on one that fits the contact."""
    wrong, count, flagged = 0, 0, 0
    scales = itertools.product(10.0 ** np.arange(-3, 7, 3), 10.0 ** np.arange(-6, 5, 2), 10.0 ** np.arange(-3, 7, 3))
    for modulus, force, radius in scales:
        a, depth, _ = hertz(force, radius, modulus)
        for pixel in (0.1, a / 8.0):
            gap = (pixel * pixel / radius / 2.0) * _squares()
            contact = press(gap, pixel, Layer(modulus * 0.75, 0.5), force_n=force)
            trusted = not {"unresolved", "at_border"} & set(contact.flags)
            exact = math.isclose(contact.approach_mm, depth, rel_tol=0.05)
            count, flagged = count + 1, flagged + (not trusted)
            wrong += not _solved(contact, force) or (trusted and not exact)
    expected = "converged; depth within 5 % of Hertz or flagged"
    ours = f"{count - wrong} of {count} right, {flagged} of them flagged"
    naive, naive_holds = _naive_at_every_scale()
    return HardCase(_CONTACT, "ball at every scale", expected, naive, ours, wrong == 0, naive_holds)


def _naive_at_every_scale() -> tuple[str, bool]:
    """Count correct depths of the unsafeguarded iteration, which has no flags, for a ball of 1 m on 0.3 MPa."""
    forces, modulus, radius = 10.0 ** np.arange(-6, 5, 2), 0.3 / 0.75, 1e3
    gap, right = _squares() * (0.1 * 0.1 / radius / 2.0), 0
    operator = Operator(influence(gap.shape, math.inf, 0.5), gap.shape)
    for force in forces:
        pressure, _ = naive_solve(operator, gap / 0.1, force / modulus / 0.01, _NAIVE_CAP)
        depth = 0.1 * float((operator(pressure) + gap / 0.1)[pressure > 0.0].mean())
        right += math.isclose(depth, hertz(force, radius, modulus)[1], rel_tol=0.05)
    return f"{right} of {len(forces)} forces right", right == len(forces)


def hard_gaps() -> dict[str, Floats]:
    """Return hard height maps, in pixels of 1 mm."""
    squares, plane = _squares(), np.zeros((_SIDE, _SIDE))
    y, x = np.indices(plane.shape) - _SIDE / 2.0
    pin, alone, islands = plane + 1.0, plane + np.inf, plane + np.inf
    pin[9, 9] = alone[9, 9] = islands[4:8, 4:8] = 0.0
    islands[20:24, 20:24] = 0.3
    return {
        "sharp ball": squares * 1e3,
        "ball": squares / 200.0,
        "flat ball": squares / 2e6,
        "punch": np.where(squares < 60.0, 0.0, np.inf),
        "cone": np.sqrt(squares) * 0.3,
        "edge": np.abs(x) * 1.0,
        "half plane": np.where(x < 0.0, 0.0, np.inf),
        "step": np.where(x < 0.0, 0.0, 0.5) + y * 1e-3,
        "rough": np.random.default_rng([3]).random(plane.shape) * 0.3,
        "checkers": np.where((x + y) % 2 == 0.0, 0.0, 0.05),
        "plane": plane,
        "pin": pin,
        "pin alone": alone,
        "islands": islands,
        "one pixel of map": plane[:1, :1],
        "one row": squares[:1] / 200.0,
        "one column": squares[:, :1] / 200.0,
    }


def hard_layers() -> tuple[Layer, ...]:
    """Return the half-space and layers thick and thin, compressible and not."""
    kinds = (
        (0.5, math.inf),
        (0.48, math.inf),
        (0.48, 10.0),
        (0.5, 10.0),
        (0.0, 10.0),
        (0.48, 1.0),
        (0.5, 1.0),
        (0.5, 0.1),
    )
    return tuple(Layer(0.2, poisson, thickness) for poisson, thickness in kinds)


def _every_shape() -> HardCase:
    wrong, count = 0, 0
    for gap, layer in itertools.product(hard_gaps().values(), hard_layers()):
        for force in (1e-6, 1e-2, 1.0, 40.0, 1e4):
            contact = press(gap, 1.0, layer, force_n=force)
            count, wrong = count + 1, wrong + (not _solved(contact, force))
    expected = "converged, nothing NaN, the force carried"
    solved = [_naive(gap, hard_layers()[0], 1.0)[1] for gap in hard_gaps().values()]
    naive, ours = f"{sum(solved)} of {len(solved)} on the half-space, 1 N", f"{count - wrong} of {count}"
    return HardCase(_CONTACT, "hard shapes on hard layers", expected, naive, ours, wrong == 0, all(solved))


def naive_close(motion: Motion, duration_s: float, step_s: float) -> Floats:
    """Return the end state (6,) by explicit Euler: it diverges unless the step resolves the contact's oscillation."""
    state = np.zeros(6)
    for _ in range(round(duration_s / step_s)):
        state = state + step_s * motion.rate(state)[0]
    return state


def _stiff_closing() -> HardCase:
    """1e2 to 1e9 N/m, 20 N, the jaws 2 mm and 1 mm away, explicit steps of 1 ms."""
    naive, ours, wrong = [], [], 0
    for stiffness in 10.0 ** np.arange(-1.0, 7.0):
        law = partial(spring, float(stiffness))
        motion = Motion(20.0, (law, law), (2.0, 1.0))
        duration = 10.0 if stiffness < 1.0 else 1.0  # a soft spring is pressed slowly
        force = motion.contact_forces(close(motion, duration))[0][0]
        ours.append(f"{force:.4g}")
        naive.append(f"{motion.contact_forces(naive_close(motion, duration, 1e-3))[0][0]:.3g}")
        wrong += abs(force - 20.0) > 0.05
    right = [abs(float(force) - 20.0) <= 0.05 for force in naive]
    case = "closing at 1e2 to 1e9 N/m"
    return HardCase(_CLOSING, case, "20 N", ", ".join(naive), ", ".join(ours), wrong == 0, all(right))
