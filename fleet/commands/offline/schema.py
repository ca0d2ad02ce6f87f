"""Print the public interface: keys, fields, units.

The text is read from `fleet/contract.py`, so it always matches the messages.
"""

import argparse
import enum
import textwrap
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec

from fleet.bus.bus_protocol import key_of
from fleet.bus.codec import encoding
from fleet.contract import COLUMNS, EXTRA_COLUMNS, PER_UAV, QUERIES, TOPICS, Sample, meaning

EXAMPLES = """
  fleet schema                        every key in one table
  fleet schema prediction             the fields of one message
  fleet schema sample --json          JSON schema, key, encoding and attachment
"""

ATTACHMENT = "16 bytes, little endian: epoch u64, writer u64; keep the highest epoch per UAV below now + 5 min"
STAMPED = ("model", "prediction", "mismatch", "alert")  # topics of workers, with the attachment


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("topic", nargs="?", choices=sorted(TOPICS), metavar="TOPIC", help=" ".join(TOPICS))
    parser.add_argument("--json", action="store_true", help="JSON schema instead of tables")


def run(args: argparse.Namespace) -> int:
    """Print one topic, or the table of all keys and then every topic."""
    chosen = [TOPICS[args.topic]] if args.topic else list(TOPICS.values())
    if args.json:
        described = msgspec.json.encode({topic_of(kind): as_json(kind) for kind in chosen})  # nan becomes null
        print(msgspec.json.format(described, indent=2).decode())
        return 0
    if not args.topic:
        print("\n".join(f"{wire_key(kind):34} {encoding(kind):46} {summary(kind)}" for kind in chosen), end="\n\n")
    print("\n\n".join(as_text(kind) for kind in chosen))
    return 0


def topic_of(kind: type) -> str:
    """Return the topic of a message class."""
    return str(kind.topic)  # type: ignore[attr-defined]


def wire_key(kind: type) -> str:
    """Return the key with its variable chunk in braces."""
    return key_of(kind, "{uav}" if kind in PER_UAV else "{writer}")


def summary(kind: type) -> str:
    """Return the first line of the docstring of a class."""
    return (kind.__doc__ or "").strip().splitlines()[0]


def as_json(kind: type) -> dict[str, Any]:
    """Describe a class as a JSON object: key, encoding, attachment, schema."""
    payload = QUERIES.get(kind)
    (schema, *query_schemas), components = msgspec.json.schema_components([kind, *filter(None, [payload])])
    described = {
        "key": wire_key(kind),
        "encoding": encoding(kind),
        "attachment": ATTACHMENT if topic_of(kind) in STAMPED else None,
        "query": query_schemas[0] if query_schemas else None,
        "schema": schema,
        "components": components,
    }
    if kind is Sample:
        for key, columns in (("columns", COLUMNS), ("extra_columns", EXTRA_COLUMNS)):
            described[key] = {name: [{"name": n, "unit": u} for n, u in rows] for name, rows in columns.items()}
    return described


def as_text(kind: type) -> str:
    """Describe a class as text: its key, its fields, then the structs and enumerations they use."""
    lines = [f"{wire_key(kind)}   {summary(kind)}", f"  encoding    {encoding(kind)}"]
    if topic_of(kind) in STAMPED:
        lines.append(f"  attachment  {ATTACHMENT}")
    if kind in QUERIES:
        lines.append(f"  query       may carry a {QUERIES[kind].__name__}, a msgpack map")
    lines += fields_of(kind)
    for part in parts_of(kind):
        lines += ["", f"  {part.__name__}: {summary(part)}"]
        lines += [f"    {member.value}" for member in part] if issubclass(part, enum.Enum) else fields_of(part)
    if kind is Sample:
        lines += ["", "  columns of each Rows field, in order:"]
        for name, rows in COLUMNS.items():
            columns = f"    {name:10} " + ", ".join(f"{n} [{u}]" for n, u in rows)
            lines += textwrap.wrap(columns, 118, subsequent_indent=" " * 15)
        for name, rows in EXTRA_COLUMNS.items():
            wide = f"    {name:10} in messages in which one of these is not 0, also: " + ", ".join(n for n, _ in rows)
            lines += textwrap.wrap(wide, 118, subsequent_indent=" " * 15)
    return "\n".join(lines)


def fields_of(kind: type) -> list[str]:
    """Return one line per field: name, type, default, meaning with unit."""
    hints, lines = get_type_hints(kind, include_extras=True), []
    for field in msgspec.structs.fields(kind):
        hint = hints[field.name]
        default = "required" if field.required else f"= {default_of(field)}"
        line = f"    {field.name:16} {type_name(hint):22} {default:12} {meaning(hint)}"
        lines += textwrap.wrap(line.rstrip(), 118, subsequent_indent=" " * 57, drop_whitespace=True, tabsize=1)
    return lines


def default_of(field: msgspec.structs.FieldInfo) -> str:
    """Format the default as JSON."""
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    return msgspec.json.encode(value).decode() if value == value else "nan"


def type_name(hint: Any) -> str:
    """Return a short name of a type: `int`, `Array`, `map of float`, `list of Item`, `float or null`."""
    origin, inner = get_origin(hint), get_args(hint)
    if hasattr(hint, "__metadata__"):
        return type_name(inner[0])
    if origin in (Union, UnionType):
        return " or ".join("null" if part is type(None) else type_name(part) for part in inner)
    if origin is dict:
        return f"map of {type_name(inner[1])}"
    if origin is tuple:
        return f"list of {type_name(inner[0])}" if inner[-1] is ... else f"[{', '.join(map(type_name, inner))}]"
    return str(hint.__name__)


def parts_of(kind: type) -> list[type]:
    """List the structs and enumerations used by a class, each once, in order of appearance."""
    parts: list[type] = []

    def walk(hint: Any) -> None:
        for part in get_args(hint):
            walk(part)
        if isinstance(hint, type) and issubclass(hint, (msgspec.Struct, enum.Enum)) and hint not in parts:
            parts.append(hint)
            if issubclass(hint, msgspec.Struct):
                for inner in get_type_hints(hint, include_extras=True).values():
                    walk(inner)

    walk(kind)
    walk(QUERIES.get(kind))
    return parts[1:]
