"""Reads the pose of a robot, and sends it to a goal, as any program with Zenoh can.

    client.py tcp/127.0.0.1:7447
"""

import json
import queue
import sys

import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("connect/timeout_ms", "20000")

with zenoh.open(config) as session:
    # What the keys hold, in JSON Schema.
    schemas = {
        str(answer.ok.key_expr): json.loads(answer.ok.payload.to_string())
        for answer in session.get("ranger/**/@schema")
    }
    pose = schemas["ranger/pose/@schema"]
    assert pose["properties"]["x"]["x-unit"] == "m", pose
    print("keys:", ", ".join(sorted(key.removesuffix("/@schema") for key in schemas)))

    poses = queue.Queue()
    reader = session.declare_subscriber("ranger/pose", poses.put)
    first = poses.get(timeout=20)
    assert str(first.encoding) == "application/json;demo/pose@1", first.encoding
    print("the robot is at", json.loads(first.payload.to_string())["x"])

    session.put("ranger/goal", json.dumps({"x": "far"}))  # refused, and a fault there
    session.put("ranger/goal", json.dumps({"x": 3.5}))
    while json.loads(poses.get(timeout=20).payload.to_string())["x"] != 3.5:
        pass
    print("the robot is at 3.5")
