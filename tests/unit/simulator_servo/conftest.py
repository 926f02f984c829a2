"""A servo task with memory and variables, without the command language."""

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.memory import registers as reg
from pmac_comp.simulator.memory.memory import Memory
from pmac_comp.simulator.memory.variables import Variables
from pmac_comp.simulator.servo.servo import Servo

BENCH = load_bench("paper")


def new_servo(plant=None, bench=BENCH):
    memory = Memory()
    memory.x[reg.MEMORY_END] = reg.USER_BUFFER_END_STANDARD
    memory.y[reg.DPRAM_END_REGISTER] = 0x64000
    memory.y[reg.PROGRAM_END] = reg.USER_BUFFER_START
    variables = Variables(memory)
    variables.set_factory_values()
    for name, value in bench.controller.ivariables.items():
        variables.write_i(int(name[1:]), value)
    variables.write_i(8000, 0xC78000)
    variables.write_i(8001, 0xC78008)
    servo = Servo(variables, bench, plant)
    servo.boot()
    servo.run(20)
    return servo


@pytest.fixture
def servo():
    return new_servo()


@pytest.fixture
def enabled(servo):
    servo.enable(1)
    servo.run(200)
    return servo


@pytest.fixture
def make_servo():
    return new_servo
