"""Listens to a running graph from outside: ``python examples/listen.py ADDRESS RUN [STAGE/PORT]``.

ADDRESS is what the graph file says after ``listen:``, RUN is what ``runner ps`` prints; neither needs this project.
"""

import json
import sys

import msgpack
import zenoh

address, run, topic = (*sys.argv[1:3], *sys.argv[3:], "*/*")[:3]
config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [address]}}))
with zenoh.open(config) as session, session.declare_subscriber(f"{run}/m/{topic}") as messages:
    print("listening", flush=True)
    for sample in messages:
        envelope = msgpack.unpackb(sample.payload.to_bytes())  # as the JSON Schema of its topic in a recording says
        shown = {
            name: value if isinstance(value, (int, float, str)) else "..." for name, value in envelope["body"].items()
        }
        print(envelope["id"], envelope["type"], shown, flush=True)
