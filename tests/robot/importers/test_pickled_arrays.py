"""Arrays from pickles: arrays that NumPy wrote are equal after reading, everything else is refused in one line."""

import ast
import inspect
import pickle
import pickletools
import struct
import tracemalloc
from collections import OrderedDict

import numpy as np
import pytest

from robot.errors import ImporterError
from robot.importers import pickled_arrays
from robot.importers.pickled_arrays import MAX_BYTES, MAX_OPCODES, read_array

DTYPES = ("<f8", "<f4", "<f2", ">f8", "<i4", "|u1", "<u2", ">i8", "|b1")
ARRAYS = [(np.arange(12).reshape(3, 4) % 5).astype(dtype) for dtype in DTYPES]
ARRAYS += [np.asfortranarray(np.arange(12.0).reshape(3, 4)), np.arange(5.0), np.ones((2, 3, 4, 5), np.float32)]
PROTOCOLS = (3, 4, 5)
HEIGHTS = np.random.default_rng(5).normal(size=(24, 32))


def error_line(data):
    """Return the error for invalid bytes, which must be one line."""
    with pytest.raises(ImporterError) as caught:
        read_array(data)
    message = str(caught.value)
    assert message.startswith("it ")
    assert len(message.splitlines()) == 1
    assert len(message) < 200
    return message


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype.str}-{array.ndim}")
def test_a_pickled_array_is_read_unchanged(array, protocol):
    found = read_array(pickle.dumps(array, protocol=protocol))
    np.testing.assert_array_equal(found, array)
    assert found.dtype == array.dtype.newbyteorder("=")


def test_the_module_does_not_import_pickle_or_call_functions_by_name():
    tree = ast.parse(inspect.getsource(pickled_arrays))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not imported & {"pickle", "_pickle", "importlib", "copyreg", "builtins"}
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    assert not names & {"eval", "exec", "getattr", "__import__", "compile"}


@pytest.mark.parametrize(
    "thing",
    [
        print,
        OrderedDict(a=1),
        {"a": HEIGHTS},
        [HEIGHTS],
        (HEIGHTS, HEIGHTS),
        "text",
        7,
        None,
        b"bytes",
        np.float64(3),
        np.dtype("f8"),
        np.array([object()], dtype=object),
        np.array(["text"]),
        np.array([1 + 2j]),
        np.array(["2020"], dtype="datetime64[Y]"),
        np.zeros(3, dtype=[("a", "f8")]),
        np.ma.array([1, 2], mask=[0, 1]),
        np.zeros((0, 3)),
        np.array(3.0),
        np.zeros((1,) * 5),
        np.random.default_rng(0),
    ],
    ids=lambda thing: type(thing).__name__,
)
@pytest.mark.parametrize("protocol", [0, 2, *PROTOCOLS])
def test_everything_except_an_array_of_numbers_is_refused(thing, protocol):
    error_line(pickle.dumps(thing, protocol=protocol))


class Calls:
    """An object whose pickle calls a function when it is loaded."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


@pytest.mark.parametrize("protocol", [0, 1, 2, *PROTOCOLS])
def test_a_program_instead_of_the_array_or_of_a_part_of_it_does_not_run(protocol, tmp_path):
    target = tmp_path / "made"
    for hidden in (Calls(open, str(target), "w"), [HEIGHTS, Calls(open, str(target), "w")]):
        error_line(pickle.dumps(hidden, protocol=protocol))
        assert not target.exists()
    rebuild, arguments, state = HEIGHTS.__reduce__()[:3]
    for place in range(5):
        forged = (*state[:place], Calls(open, str(target), "w"), *state[place + 1 :])
        error_line(pickle.dumps(Rebuilt(rebuild, arguments, forged), protocol=protocol))
        assert not target.exists()


class Rebuilt:
    def __init__(self, *parts):
        self.parts = parts

    def __reduce__(self):
        return self.parts


def forged(**changes):
    """Return the pickle of HEIGHTS with changes of its state."""
    rebuild, arguments, (version, shape, dtype, fortran, data) = HEIGHTS.__reduce__()[:3]
    state = {"version": version, "shape": shape, "dtype": dtype, "fortran": fortran, "data": data} | changes
    return pickle.dumps(Rebuilt(rebuild, arguments, tuple(state.values())), protocol=4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": (24, 33)}, "its shape needs 6,336 bytes, got 6,144"),
        ({"shape": (2**62, 2**62)}, "its shape must have"),
        ({"shape": (-24, -32)}, "its shape must have"),
        ({"shape": (24, True)}, "its shape must have"),
        ({"shape": 768}, "its shape must have"),
        ({"shape": ()}, "its shape must have"),
        ({"shape": (MAX_BYTES, MAX_BYTES, MAX_BYTES)}, "its shape needs"),
        ({"dtype": "f8"}, "the type or the bytes of its numbers are missing"),
        ({"data": "text"}, "the type or the bytes of its numbers are missing"),
        ({"data": None}, "the type or the bytes of its numbers are missing"),
        ({"dtype": np.dtype("f4")}, "its shape needs 3,072"),
    ],
)
def test_an_invalid_state_is_refused_with_the_reason(changes, message):
    assert message in error_line(forged(**changes))


def array_or_line(data):
    try:
        return read_array(data)
    except ImporterError as error:
        return str(error)


# The opcodes, by hand -------------------------------------------------------------------------------------------

ARRAY = pickle.dumps(HEIGHTS, protocol=4)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "damaged or cut off"),
        (b"\x80\x04", "damaged or cut off"),
        (b".", "contains something else"),
        (b"\x80\x04h\x05.", "BINGET refers to nothing"),
        (b"\x80\x04\x94.", "MEMOIZE refers to nothing"),
        (b"\x80\x04t.", "TUPLE refers to nothing"),
        (b"\x80\x04\x85.", "its stack is empty"),
        (b"\x80\x04R.", "its stack is empty"),
        (b"\x80\x04b.", "its stack is empty"),
        (b"\x80\x04K\x01b.", "BUILD refers to nothing"),
        (b"\x80\x04K\x01K\x01b.", "a state is not a tuple"),
        (b"\x80\x04))b.", "a state belongs to something else"),
        (b"\x80\x04)R.", "its stack is empty"),
        (b"\x80\x04))R.", "it calls a function that does not make an array"),
        (b"\x80\x04K\x012.", "does not have the opcode DUP"),
        (b"\x80\x04}.", "not have the opcode EMPTY_DICT"),
        (b"\x80\x04]2a.", "not have the opcode EMPTY_LIST"),
        (b"cos\nsystem\n(S'true'\ntR.", "it refers to 'os' 'system'"),
        (b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93.", "it refers to 'builtins' 'eval'"),
        (b"\x80\x04K\x01K\x02\x93.", "it refers to"),
        (b"\x80\x04))\x93.", "it refers to"),
        (b"(dp0\n.", "not have the opcode DICT"),
        (b"\x80\x04\x8c\x01aQ.", "not have the opcode BINPERSID"),
        (b"\x80\x05\x97.", "not have the opcode NEXT_BUFFER"),
        (b"\x80\x02\x82\x01.", "not have the opcode EXT1"),
        (b"I" + b"9" * 100_000 + b"\n.", ""),
        (b"L" + b"9" * 100_000 + b"L\n.", ""),
        (b"\x8b" + struct.pack("<i", 2**31 - 1) + b"\x00" * 9, "damaged or cut off"),
        (b"\x8d" + struct.pack("<Q", 2**63 - 1) + b"abc.", "damaged or cut off"),
        (b"\x8e" + struct.pack("<Q", 2**64 - 1) + b"abc.", "damaged or cut off"),
        (b"B" + struct.pack("<I", 2**32 - 1) + b"abc.", "damaged or cut off"),
        (b"\x80\x04r" + struct.pack("<I", 2**32 - 1) + b".", "LONG_BINPUT refers to nothing"),
        (b"N" * (MAX_OPCODES + 1) + b".", f"more than {MAX_OPCODES} opcodes"),
        (b"(" * 10_000_000, f"more than {MAX_OPCODES} opcodes"),
        (bytes(MAX_BYTES + 1), "more than 67,108,864"),
    ],
    ids=lambda value: repr(value)[:24],
)
def test_forged_opcodes_are_refused_in_one_line(data, message):
    assert message in error_line(data)


def test_a_memo_cannot_make_a_small_file_large():
    """Each tuple contains its predecessor twice: 2 ** 40 parts as a tree, 40 as references."""
    data = b"\x80\x04)\x94" + b"".join(b"h%ch%c\x86\x94" % (place, place) for place in range(40)) + b"."
    tracemalloc.start()
    message = error_line(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "contains something else" in message
    assert peak < 2**20


def test_a_tuple_of_tuples_instead_of_a_name_or_a_type_is_not_printed():
    nested = b")\x94" + b"".join(b"h%ch%c\x86\x94" % (place, place) for place in range(30))
    tracemalloc.start()
    error_line(b"\x80\x04" + nested + b"\x8c\x01a\x93.")
    error_line(b"\x80\x04cnumpy\ndtype\n" + nested + b"NN\x87R.")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_an_array_cannot_contain_itself_or_be_filled_twice():
    empty = b"\x80\x04cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R\x94"
    assert "a state is not a tuple" in error_line(empty + b"h\x00b.")
    assert "the type or the bytes of its numbers are missing" in error_line(empty + b"(K\x01K\x01\x85h\x00Nh\x00tb.")
    assert "occurs twice" in error_line(ARRAY[:-1] + b"(NNNNNtb.")


def test_other_opcodes_never_make_another_array():
    """Every opcode, with an argument of zeros, before and within the pickle of an array."""
    for opcode in pickletools.opcodes:
        for tail in (b"", b"\x00" * 16, b"0\n", b"\x01a\n"):
            code = opcode.code.encode("latin-1")
            for data in (code + tail + b".", ARRAY[:11] + code + tail + ARRAY[11:], ARRAY[:-1] + code + tail + b"."):
                found = array_or_line(data)
                assert isinstance(found, str) or found.shape == HEIGHTS.shape


# Fuzz ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_pickle_cut_anywhere_is_refused(protocol):
    data = pickle.dumps(np.arange(6.0).reshape(2, 3), protocol=protocol)
    for end in range(len(data)):
        error_line(data[:end])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_random_damage_gives_an_array_or_an_error_line_with_bounded_memory(protocol):
    whole = pickle.dumps(np.arange(6.0).reshape(2, 3), protocol=protocol)
    rng = np.random.default_rng(protocol)
    codes = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
    tracemalloc.start()
    for _ in range(4000):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 5)):
            place = int(rng.integers(0, len(data)))
            match rng.integers(0, 4):
                case 0:
                    data[place] = int(rng.integers(0, 256))
                case 1:
                    data[place:place] = codes[rng.integers(0, len(codes))]
                case 2:
                    del data[place : place + int(rng.integers(1, 9))]
                case _:
                    other = int(rng.integers(0, len(data)))
                    data[place:place] = data[other : other + int(rng.integers(1, 30))]
        found = array_or_line(bytes(data))
        if isinstance(found, str):
            assert len(found.splitlines()) == 1
            assert len(found) < 200
        else:
            assert found.nbytes <= len(data)
            assert found.dtype.kind in "fiub"
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_a_large_array_takes_a_small_multiple_of_its_file():
    data = pickle.dumps(np.zeros((1000, 1000)), protocol=4)
    tracemalloc.start()
    read_array(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5 * len(data)


def test_damage_in_the_bytes_of_numbers_changes_only_these_numbers():
    array = np.arange(6.0).reshape(2, 3)
    whole = pickle.dumps(array, protocol=4)
    start = whole.index(array.tobytes())
    for place in range(start, start + array.nbytes):
        data = bytearray(whole)
        data[place] ^= 0xFF
        expected = np.frombuffer(bytes(data[start : start + array.nbytes])).reshape(2, 3)
        np.testing.assert_array_equal(read_array(bytes(data)), expected)
