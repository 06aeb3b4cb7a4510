"""Hidden objects of a running graph with pyzmq and msgpack alone: python listen.py RUN_DIR [SCANS].

RUN_DIR is what `mirrorwave doctor` names; nothing of mirrorwave is imported.
"""

import sys
from pathlib import Path

import msgpack
import zmq

TOPIC = "perception/hidden_objects"


def main(run_dir: str, scans: int = 3) -> int:
    """Print the objects of so many scans."""
    subscriber = zmq.Context().socket(zmq.SUB)
    subscriber.set(zmq.RCVTIMEO, 10_000)
    # the zero byte ends the name, so that no topic is another's beginning
    subscriber.set(zmq.SUBSCRIBE, TOPIC.encode() + b"\0")
    for path in Path(run_dir).glob(TOPIC.replace("/", ".") + "@*"):
        subscriber.connect(f"ipc://{path}")
    for _ in range(scans):
        _topic, header, *arrays = subscriber.recv_multipart()
        view = msgpack.unpackb(header)["body"]
        places = [f"{one['x_m']:.1f}, {one['y_m']:.1f} m" for one in view["objects"]]
        direct = view["los_points_m"]
        print(f"scan {view['scan_id']}: {'; '.join(places) or 'nothing hidden'}; ", end="")
        print(f"{direct['shape'][0]} direct returns in {len(arrays[direct['frame']])} bytes of {direct['dtype']}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], *map(int, sys.argv[2:3])))
