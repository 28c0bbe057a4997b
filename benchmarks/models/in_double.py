"""`python -m benchmarks.models.in_double COMMAND ...`: run retrieve with float64 in place of float32.

This removes rounding from a comparison of two ways to train. In float32, another order of a sum is
enough to change the weights of trained towers, after some steps as much as another seed would.
"""

import sys

import torch

torch.set_default_dtype(torch.float64)
_single, _from_numpy, _numpy = torch.float32, torch.from_numpy, torch.Tensor.numpy


def _double_of(array):
    tensor = _from_numpy(array)
    return tensor.double() if tensor.dtype == _single else tensor


def _single_of(tensor, **options):
    array = _numpy(tensor, **options)
    return array.astype("float32") if array.dtype == "float64" else array


torch.from_numpy, torch.Tensor.numpy, torch.Tensor.float = _double_of, _single_of, torch.Tensor.double
torch.float32 = torch.float64

if __name__ == "__main__":
    from retrieval.commands.main import main

    sys.exit(main(sys.argv[1:]))
