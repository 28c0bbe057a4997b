"""A posterior and a calibration of verifications with bounds of the caller's choice."""

from retrieval.model.posterior import Posterior
from retrieval.model.verification import LEVELS, MAX_GRASPS, QUANTILES, VerificationCalibration

POSTERIOR = Posterior(slope=1.0, offset=0.0)


def calibration(accept, reject):
    """Return a calibration whose bounds are these at every rate."""
    return VerificationCalibration(
        group_sizes=(100,),
        impostors=(accept,) * len(LEVELS),
        similar=(accept - 1,) * len(QUANTILES),
        genuine=((accept + 1,) * len(QUANTILES),) * MAX_GRASPS,
        lowest=(reject,) * len(QUANTILES),
    )
