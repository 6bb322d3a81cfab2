"""Show a recording on the live page until Ctrl-C, with the results of identifier and model.

They start from the set in use at the beginning of the recording. Without --bag, the node live shows
the running system.
"""

from __future__ import annotations

import argparse
import threading
from contextlib import closing

from mr_damper_ros.live.page_server import PageServer
from mr_damper_ros.live.recorded import empty_record, replay_into
from mr_damper_ros.tools.console import add_path, add_port_option, program
from mr_damper_ros.tracking.state_directory import read_parameter_file


def _options(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--bag", "FILE", "the recording", required=True)
    add_path(parser, "--parameters", "FILE", "parameter set to start from instead")
    add_port_option(parser)


def _serve(options: argparse.Namespace) -> int:
    start = None if options.parameters is None else read_parameter_file(options.parameters)
    record = empty_record(options.bag)
    with closing(PageServer(record, "127.0.0.1", options.port)) as server:
        print(f"the page is at {server.address}; Ctrl-C ends it", flush=True)
        replay_into(record, options.bag, start)
        print("the whole recording is shown", flush=True)
        threading.Event().wait()
    return 0


main = program("live", __doc__, _options, _serve)
