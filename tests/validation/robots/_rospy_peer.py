"""A node of rospy with ROS 1's own generated messages: what our bus meets. Nothing of vlatool is imported.

python _rospy_peer.py echo | images N | call | subscribe TOPIC | malformed | publish TOPIC
"""

from __future__ import annotations

import json
import queue
import sys
import threading
import time

import actionlib
import numpy as np
import rospy
from actionlib.msg import TestAction, TestFeedback, TestGoal, TestResult
from geometry_msgs.msg import Twist
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import SetBool, SetBoolResponse

WIDTH, HEIGHT = 320, 240


def echo() -> None:
    """Send each Twist back, answer /peer_set, publish a latched String; until killed."""
    back = rospy.Publisher("/back", Twist, queue_size=2000, tcp_nodelay=True)
    rospy.Subscriber("/there", Twist, back.publish, queue_size=2000, tcp_nodelay=True)
    rospy.Service("/peer_set", SetBool, lambda request: SetBoolResponse(request.data, "peer ü"))
    rospy.Service("/peer_fails", SetBool, lambda request: 1 / 0)
    rospy.Service("/peer_late", SetBool, lambda request: time.sleep(5) or SetBoolResponse())
    latched = rospy.Publisher("/latched", String, latch=True, queue_size=1)
    latched.publish(String("walls"))
    say("ready")
    rospy.spin()


def images(number: int) -> None:
    """Publish images, wait for the Twist that answers each, and print the times in ms."""
    answers: queue.Queue[Twist] = queue.Queue()
    rospy.Subscriber("/answer", Twist, answers.put, tcp_nodelay=True)
    publisher = rospy.Publisher("/image", Image, queue_size=1, tcp_nodelay=True)
    wait_for(lambda: publisher.get_num_connections() and not rospy.is_shutdown())
    data = np.random.default_rng(0).integers(0, 256, WIDTH * HEIGHT * 3, np.uint8).tobytes()
    image = Image(height=HEIGHT, width=WIDTH, encoding="rgb8", step=3 * WIDTH, data=data)
    times, right = [], 0
    time.sleep(0.5)
    for index in range(number):
        image.header.stamp = rospy.Time(index, index)
        began = time.perf_counter()
        publisher.publish(image)
        try:
            answer = answers.get(timeout=1.0)
        except queue.Empty:
            continue
        times.append((time.perf_counter() - began) * 1e3)
        right += answer.linear.x == index and answer.angular.z == float(sum(data[:9]))
        time.sleep(0.005)
    say({"times": times, "right": right, "bytes": len(data)})


def call() -> None:
    """Call /our_set and /our_fails and print the answers."""
    rospy.wait_for_service("/our_set", 5.0)
    answers = [rospy.ServiceProxy("/our_set", SetBool)(value) for value in (True, False)]
    try:
        rospy.ServiceProxy("/our_fails", SetBool)(True)
        failure = ""
    except rospy.ServiceException as error:
        failure = str(error)
    say({"answers": [[each.success, each.message] for each in answers], "failure": failure})


def subscribe(topic: str) -> None:
    """Print the bytes of each Twist of a topic; until killed."""
    from io import BytesIO

    def show(message: Twist) -> None:
        buffer = BytesIO()
        message.serialize(buffer)
        say(buffer.getvalue().hex())

    rospy.Subscriber(topic, Twist, show, tcp_nodelay=True)
    say("ready")
    rospy.spin()


def action_server() -> None:
    """Serve /peer_action as actionlib does: three times the goal; a negative goal lasts until it is canceled."""

    def run(goal: TestGoal) -> None:
        server.publish_feedback(TestFeedback(2 * goal.goal))
        while goal.goal < 0 and not server.is_preempt_requested():
            time.sleep(0.01)
        end = server.set_preempted if goal.goal < 0 else server.set_succeeded
        end(TestResult(3 * goal.goal))

    server = actionlib.SimpleActionServer("/peer_action", TestAction, run, auto_start=False)
    server.start()
    say("ready")
    rospy.spin()


def action_client() -> None:
    """Send goals to /our_action, one of which is canceled, and print how they ended."""
    client = actionlib.SimpleActionClient("/our_action", TestAction)
    if not client.wait_for_server(rospy.Duration(10)):
        raise SystemExit("no server within ten seconds")
    said: list[int] = []
    client.send_goal(TestGoal(7), feedback_cb=lambda each: said.append(each.feedback))
    client.wait_for_result(rospy.Duration(10))
    first = [client.get_state(), client.get_result().result, said]
    client.send_goal(TestGoal(-7))
    while client.get_state() != actionlib.GoalStatus.ACTIVE:
        time.sleep(0.01)
    client.cancel_goal()
    client.wait_for_result(rospy.Duration(10))
    say([first, [client.get_state(), client.get_result().result]])


class Junk(Twist):
    """Says that it is a Twist, and is ten bytes."""

    def serialize(self, buff: object) -> None:
        buff.write(b"0123456789")  # type: ignore[attr-defined]


def malformed() -> None:
    """Send ten messages that are malformed, then one that is right."""
    publisher = rospy.Publisher("/junk", Junk, queue_size=20)
    wait_for(publisher.get_num_connections)
    for _ in range(10):
        publisher.publish(Junk())
    time.sleep(0.2)
    twist = Twist()
    twist.linear.x = 0.5
    publisher.impl.data_class = Twist
    publisher.publish(twist)
    say("sent")
    time.sleep(1.0)


def publish(topic: str) -> None:
    """Publish a Twist ten times a second; until killed."""
    publisher = rospy.Publisher(topic, Twist, queue_size=1)
    say("ready")
    while not rospy.is_shutdown():
        publisher.publish(Twist())
        time.sleep(0.1)


def wait_for(condition: object) -> None:
    """Wait until a condition is true, for ten seconds."""
    until = time.monotonic() + 10
    while not condition():  # type: ignore[operator]
        if time.monotonic() > until:
            raise SystemExit("waited for ten seconds")
        time.sleep(0.01)


def say(what: object) -> None:
    """Print a line of JSON at once."""
    with LOCK:
        print(json.dumps(what), flush=True)


LOCK = threading.Lock()
if __name__ == "__main__":
    mode, *arguments = sys.argv[1:]
    rospy.init_node(f"peer_{mode}", disable_signals=True)
    globals()[mode](*(int(each) if each.isdigit() else each for each in arguments))
    rospy.signal_shutdown("done")
