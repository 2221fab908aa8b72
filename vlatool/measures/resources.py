"""What a policy takes of a machine: memory, processor, power; and what a board costs."""

from __future__ import annotations

from vlatool.measures import BOARDS, HEADLINE, Quantity

JUDGEMENT = "a judgement, not a confidence interval"

SIZE = Quantity("size", "MB", section=HEADLINE, order=80)
PEAK_RSS = Quantity(
    "peak_rss", "MB", "peak memory", section=HEADLINE, order=90, column="memory", host_column="memory, this host"
)
STEADY_RSS = Quantity("steady_rss", "MB", "steady memory", order=100)
FOOTPRINT = (PEAK_RSS, STEADY_RSS, SIZE)
"""What is drawn against latency where accuracy is not known, the first that there is."""
CPU = Quantity("cpu", "cores", "processor use", "", order=90)
ENERGY_PER_ACTION = Quantity("energy_per_action", "J", order=110)
POWER_MEAN = Quantity("power_mean", "W", "mean power", order=120)
TEMPERATURE_MAX = Quantity("temperature_max", "degC", "highest temperature", order=130)

MEMORY = Quantity("memory", "MB", interval=JUDGEMENT)
USABLE_MEMORY = Quantity("usable_memory", "MB", better="more")
WATTS = Quantity("watts", "W", interval=JUDGEMENT)
ENERGY = Quantity("energy", "J", interval=JUDGEMENT)
PRICE = Quantity("price", "USD", section=BOARDS)
AVERAGE_WATTS = Quantity("average_watts", "W", section=BOARDS)
BATTERY_LIFE = Quantity("battery_life", "h", better="more", section=BOARDS)
OWNED_COST = Quantity("owned_cost", "USD", section=BOARDS)
CLOUD_COST = Quantity("cloud_cost", "USD", section=BOARDS)
BREAK_EVEN = Quantity("break_even", "h", section=BOARDS)
