"""Listens to a running graph from outside: ``python examples/listen.py ADDRESS RUN SCHEMAS [STAGE/PORT]``.

ADDRESS is what the graph file says after ``listen:``, RUN is what ``runner ps`` prints, SCHEMAS is a file with what
``runner schema GRAPH`` prints: the JSON Schema of every message by STAGE/PORT. Nothing else of this project is needed.
"""

import json
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh

address, run, schemas, topic = (*sys.argv[1:4], *sys.argv[4:], "*/*")[:4]
described = json.loads(Path(schemas).read_text())


def decoded(value: Any, schema: dict[str, Any], structs: dict[str, Any]) -> Any:
    """A value as its schema has it: arrays as arrays, fields by name."""
    schema = structs.get(schema.get("$ref", "").rpartition("/")[2], schema)
    choices = [one for one in schema.get("anyOf", []) if one != {"type": "null"}]
    if choices and value is not None:
        return decoded(value, choices[0], structs)
    if schema.get("title") == "array" and isinstance(value, list):
        return np.frombuffer(value[2], value[0]).reshape(value[1])
    if isinstance(value, dict):
        return {name: decoded(one, schema.get("properties", {}).get(name, {}), structs) for name, one in value.items()}
    return [decoded(one, schema.get("items", {}), structs) for one in value] if isinstance(value, list) else value


config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [address]}}))
with zenoh.open(config) as session, session.declare_subscriber(f"{run}/m/{topic}") as messages:
    print("listening", flush=True)
    for sample in messages:
        schema = described[str(sample.key_expr).partition("/m/")[2]]
        message = decoded(msgpack.unpackb(sample.payload.to_bytes()), schema, schema.get("$defs", {}))
        print(message["id"], message["type"], message["body"], flush=True)
