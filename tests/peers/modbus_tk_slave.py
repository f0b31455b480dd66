"""A slave on modbus-tk, as `libmodbus_slave.c`: "tcp" or a serial port as argument, the TCP port as output."""

from __future__ import annotations

import socket
import sys
import time

import serial
from modbus_tk import defines, hooks, modbus_rtu, modbus_tcp

UNIT = 17
START_S = 5.0


def wait_until_open(port: int) -> None:
    """The server opens its port in a thread and does not say when."""
    end_s = time.monotonic() + START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=START_S).close()
        except ConnectionRefusedError:
            if time.monotonic() > end_s:
                raise
        else:
            return


def main(place: str) -> None:
    """Serve until the input ends."""
    port = 0
    if place == "tcp":
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        server = modbus_tcp.TcpServer(port=port, address="127.0.0.1")
    else:
        server = modbus_rtu.RtuServer(serial.Serial(place, 115200))
    unit = server.add_slave(UNIT)
    unit.add_block("holding", defines.HOLDING_REGISTERS, 0, 100)
    unit.add_block("input", defines.ANALOG_INPUTS, 0, 100)
    unit.set_values("input", 0, [i * i for i in range(100)])

    def follow(_: object) -> None:
        unit.set_values("input", 0, unit.get_values("holding", 0, 1))

    hooks.install_hook("modbus.Server.after_handle_request", follow)
    server.start()
    if port:
        wait_until_open(port)
    print(port, flush=True)
    sys.stdin.read()
    server.stop()


main(sys.argv[1])
