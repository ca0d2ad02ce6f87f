"""The contract on the wire: golden bytes, a foreign reader, another version, hostile bytes, units."""

import re
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet import contract
from fleet.bus.codec import Stamp, decode, encode, encoding, pack_stamp, unpack_stamp
from fleet.commands.offline.schema import parts_of
from fleet.contract import COLUMNS, DTYPES, TOPICS, Array, Params, Prediction, Sample, meaning
from tests.support.examples import EXAMPLES

GOLDEN = Path(__file__).parents[1] / "golden"
KINDS = list(TOPICS.values())


def golden(kind: type) -> Path:
    return GOLDEN / f"{kind.topic.lstrip('@').replace('/', '.')}.bin"


def golden_bytes(kind: type) -> bytes:
    """The kept bytes of one class; a missing file is a failure that says how to make it."""
    if not golden(kind).exists():
        pytest.fail(
            f"{golden(kind).name} is missing; add one to tests/support/examples.py, then: pytest --golden {__file__}"
        )
    return golden(kind).read_bytes()


def foreign(value: Any) -> Any:
    """What a msgpack map says about a message of ours, in plain Python types."""
    return msgpack.unpackb(encode(value))


# --- golden bytes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_golden_bytes_are_kept_and_decode(kind: type, request: pytest.FixtureRequest) -> None:
    example = EXAMPLES[kind]
    if request.config.getoption("--golden"):
        golden(kind).write_bytes(encode(example))
    kept = golden_bytes(kind)
    assert decode(kind, kept, encoding(kind)) == example, "kept bytes must always decode to the same message"
    assert encode(example) == kept, "the wire changed; if fields were added with defaults: pytest --golden"


def test_no_golden_file_is_left_over() -> None:
    assert sorted(GOLDEN.glob("*.bin")) == sorted(golden(kind) for kind in KINDS)


def test_a_missing_golden_says_how_to_make_it() -> None:
    with pytest.raises(pytest.fail.Exception, match=r"newcomer.bin is missing.*--golden"):
        golden_bytes(type("Newcomer", (), {"topic": "newcomer"}))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_foreign_tool_reads_every_field(kind: type) -> None:
    read = msgpack.unpackb(golden_bytes(kind), strict_map_key=True)
    assert sorted(read) == sorted(field.encode_name for field in msgspec.structs.fields(kind))
    assert read["t"] == EXAMPLES[kind].t


def test_a_foreign_tool_reads_arrays_and_columns() -> None:
    read = msgpack.unpackb(golden_bytes(Prediction))["path"]
    path = np.frombuffer(read["data"], read["dtype"]).reshape(read["shape"])
    np.testing.assert_array_equal(path, EXAMPLES[Prediction].path.numpy())
    sample = msgpack.unpackb(golden_bytes(Sample))
    for name, columns in COLUMNS.items():
        assert sample[name]["x"]["shape"] == [len(sample[name]["t"]["data"]) // 8, len(columns)], name


# --- versions and fields ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_another_version_is_refused_in_a_sentence(kind: type) -> None:
    newer = encoding(kind)[:-1] + "9"
    with pytest.raises(ValueError) as refused:
        decode(kind, golden_bytes(kind), newer)
    assert (
        str(refused.value)
        == f"{kind.__name__}: found encoding {newer!r}, expected {encoding(kind)!r}; upgrade the older side"
    )


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_unknown_fields_are_ignored(kind: type) -> None:
    added = msgpack.packb(foreign(EXAMPLES[kind]) | {"from_the_future": {"deep": [1, b"x", None]}})
    assert decode(kind, added) == EXAMPLES[kind]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_missing_optional_fields_take_their_defaults_and_missing_required_ones_are_refused(kind: type) -> None:
    fields = msgspec.structs.fields(kind)
    required = {f.encode_name for f in fields if f.required}
    least = {name: value for name, value in foreign(EXAMPLES[kind]).items() if name in required}
    message = decode(kind, msgpack.packb(least))
    for field in fields:
        if not field.required:
            default = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
            assert repr(getattr(message, field.name)) == repr(default)  # repr, since nan is not nan
    for name in required:
        with pytest.raises(ValueError, match=name):
            decode(kind, msgpack.packb({n: v for n, v in least.items() if n != name}))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_message_cannot_be_changed(kind: type) -> None:
    with pytest.raises(AttributeError):
        EXAMPLES[kind].t = 0.0


# --- hostile bytes ---------------------------------------------------------------------------------------------------


def refused_or_read(kind: type, payload: bytes) -> None:
    """Decode and unwrap every array; anything but a message or a ValueError escapes and fails the test."""
    try:
        message = decode(kind, payload)
        for array in arrays_in(message):
            array.numpy()
    except ValueError:
        return
    assert isinstance(message, kind)


def arrays_in(value: Any) -> list[Array]:
    if isinstance(value, Array):
        return [value]
    if isinstance(value, msgspec.Struct):
        return [a for name in value.__struct_fields__ for a in arrays_in(getattr(value, name))]
    return []


@settings(max_examples=150)
@given(st.sampled_from(KINDS), st.binary(max_size=200))
def test_random_bytes_raise_only_value_error(kind: type, payload: bytes) -> None:
    refused_or_read(kind, payload)


@settings(max_examples=300)
@given(st.sampled_from(KINDS), st.data())
def test_damaged_bytes_raise_only_value_error(kind: type, data: st.DataObject) -> None:
    payload = bytearray(golden_bytes(kind))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    refused_or_read(kind, bytes(payload[: data.draw(st.integers(0, len(payload)))]))


@pytest.mark.parametrize(
    "payload",
    [
        b"\x81\xa1z" + b"\x91" * 100_000 + b"\xc0",  # deep nesting
        b"\xdf\xff\xff\xff\xff",  # a map of 4 billion entries
        b"\x83\xa3uav\x01\xa1t\x01\xa6values\xdf\xff\xff\xff\xff",
        b"\x83\xa3uav\x01\xa1t\x01\xa8sentence\xa2\xff\xfe",  # no UTF-8
        b"",
    ],
)
def test_crafted_bytes_are_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        decode(Params, payload)


# --- arrays and stamps -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_an_array_comes_back_as_it_went(dtype: str) -> None:
    values = np.arange(12).reshape(4, 3).astype(dtype)
    back = Array.of(values, dtype).numpy()
    np.testing.assert_array_equal(back, values)
    assert back.dtype.str == dtype and not back.flags.writeable
    assert Array.of(np.zeros((0, 3)), dtype).numpy().shape == (0, 3)


@pytest.mark.parametrize(
    ("dtype", "shape", "size"),
    [
        ("<f4", (2, 3), 23),
        ("<f4", (2, 3), 25),
        ("<f4", (-1,), 4),
        ("<f4", (-2, -3), 24),
        ("|O", (1,), 8),
        (">f4", (1,), 4),
        ("nonsense", (1,), 4),
        ("<f4", (2**63,), 0),
        ("<f4", (2**32, 2**32), 0),
        ("<f8", (0, 2**63), 0),
        ("|u1", (1,) * 70, 1),
    ],
)
def test_an_array_that_lies_is_refused(dtype: str, shape: tuple[int, ...], size: int) -> None:
    with pytest.raises(ValueError, match=r"^array: found .*; resend$"):
        Array(dtype, shape, bytes(size)).numpy()


def test_a_stamp_is_sixteen_bytes_little_endian() -> None:
    stamp = Stamp(epoch=1_700_000_000_123, writer=2**63 - 1)
    packed = pack_stamp(stamp)
    assert packed == stamp.epoch.to_bytes(8, "little") + stamp.writer.to_bytes(8, "little")
    assert unpack_stamp(packed) == stamp
    assert unpack_stamp(None) is None and unpack_stamp(packed[:-1]) is None and unpack_stamp(b"") is None


# --- units and words -------------------------------------------------------------------------------------------------

PARTS = {part for kind in KINDS for part in (kind, *parts_of(kind))}
STRUCTS = sorted((part for part in PARTS if issubclass(part, msgspec.Struct)), key=str)
QUANTITY = re.compile(r"^t$|_s$|_m$|_e7$|_hz$|^wind|^t0$|_t0$|^(path|tube|ahead|origin)$|_trim$|^fit|^(lat|lon|alt)_")
EXPLAINED = {"param1", "param2", "param3", "param4", "values", "parameters", "sigma"}  # by the name beside them


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.__name__)
def test_every_quantity_states_its_unit(struct: type) -> None:
    for name, hint in get_type_hints(struct, include_extras=True).items():
        if name in struct.__struct_fields__ and QUANTITY.search(name) and not plain(hint) <= {bool}:
            assert re.search(r"\[[^\]]+\]|0\.\.1", meaning(hint)), f"{struct.__name__}.{name} states no unit"


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.__name__)
def test_every_bare_float_is_described(struct: type) -> None:
    for name, hint in get_type_hints(struct, include_extras=True).items():
        if name in struct.__struct_fields__ and float in plain(hint) and name not in EXPLAINED:
            assert meaning(hint), f"{struct.__name__}.{name}: what is it?"


def plain(hint: Any) -> set[Any]:
    """Every plain type inside a hint."""
    inner = [part for part in get_args(hint) if isinstance(part, type) or get_args(part)]
    return set().union(*map(plain, inner)) if inner else {hint}


def test_columns_name_every_row_kind_of_a_sample() -> None:
    kinds = [field.name for field in msgspec.structs.fields(Sample) if field.name not in ("uav", "t")]
    assert list(COLUMNS) == kinds
    assert all(unit for columns in COLUMNS.values() for _, unit in columns)


def test_the_table_of_keys_lists_every_topic() -> None:
    table = contract.__doc__ or ""
    for kind in KINDS:
        row = rf"/{re.escape(kind.topic)}\S* +{kind.__name__} "
        assert re.search(row, table), f"{kind.__name__} is not in the table"
