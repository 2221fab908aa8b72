"""A node of zenoh-ros2-sdk, run by its own Python: it sends each Twist of /to_peer back on /from_peer.

    out/robots/zenoh-sdk/venv/bin/python tests/validation/robots/zenoh_sdk_peer.py PORT HASH

It serves SetBool, too. For each topic on its standard input it prints which nodes it sees there; for "call N" it calls
the SetBool of /vlatool_set N times and prints how many answers were right. Definition and hash of the Twist are those
of rosbags, and HASH is that of SetBool; without them the sdk would download definitions.
"""

from __future__ import annotations

import json
import sys

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_info

TYPE = "geometry_msgs/msg/Twist"
SERVICE = {"request_definition": "bool data\n", "response_definition": "bool success\nstring message\n"}


def main() -> None:
    port, store = int(sys.argv[1]), get_typestore(Stores.ROS2_JAZZY)
    definition, _ = store.generate_msgdef(TYPE, ros_version=2)
    known = {"msg_definition": definition, "type_hash": store.hash_rihs01(TYPE), "node_name": "sdk_node"}
    router = {"router_ip": "127.0.0.1", "router_port": port, "domain_id": 0}
    publisher = ROS2Publisher("/from_peer", TYPE, **known, **router)

    def answer(message: object) -> None:
        publisher.publish(linear=message.linear, angular=message.angular)

    subscriber = ROS2Subscriber("/to_peer", TYPE, answer, **known, **router)
    served = {**SERVICE, "type_hash": sys.argv[2], "node_name": "sdk_node", **router}
    server = ROS2ServiceServer("/sdk_set", "std_srvs/srv/SetBool", lambda ask: respond(ask), **served)
    client = ROS2ServiceClient("/vlatool_set", "std_srvs/srv/SetBool", **served)

    def respond(ask: object) -> object:
        return server.response_msg_class(success=ask.data, message="by the sdk")

    print("ready", publisher.type_hash, flush=True)
    for line in sys.stdin:
        if line.startswith("call "):
            print(sum(_right(client.call(data=bool(n % 2)), n) for n in range(int(line.split()[1]))), flush=True)
            continue
        info = get_topic_info(line.strip(), domain_id=0, router_ip="127.0.0.1", router_port=port, verbose=True)
        ends = [*info.publishers, *info.subscribers] if info else []
        print(json.dumps([[end.node_name, end.topic_type, end.type_hash, end.qos] for end in ends]), flush=True)

    for end in (subscriber, publisher, client, server):
        end.close()


def _right(answer: object, number: int) -> bool:
    return answer is not None and (answer.success, answer.message) == (bool(number % 2), "by vlatool")


if __name__ == "__main__":
    main()
