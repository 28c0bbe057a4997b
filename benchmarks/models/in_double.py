"""`python -m benchmarks.models.in_double COMMAND ...`: retrieve, with float64 wherever it computes with float32.

Rounding is then out of the way of whoever asks whether two ways to train are the same: in float32 the order of a sum
alone moves the weights of trained towers apart, within some steps as far as another seed would.
"""

import sys

import torch

torch.set_default_dtype(torch.float64)
_single, _from_numpy, _numpy = torch.float32, torch.from_numpy, torch.Tensor.numpy


def _double_of(array):
    made = _from_numpy(array)
    return made.double() if made.dtype == _single else made


def _single_of(tensor, **how):
    made = _numpy(tensor, **how)
    return made.astype("float32") if made.dtype == "float64" else made


torch.from_numpy, torch.Tensor.numpy, torch.Tensor.float = _double_of, _single_of, torch.Tensor.double
torch.float32 = torch.float64

if __name__ == "__main__":
    from retrieval.commands.main import main

    sys.exit(main(sys.argv[1:]))
