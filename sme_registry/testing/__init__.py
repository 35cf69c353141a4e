"""The conformance kit: what every SME environment guarantees, as checks that any test may call.

    from sme_registry.testing import check_sme, check_stream, check_team
    check_sme("SME/Default-v1")                       # or your own spec, or your own classes
    check_stream("SME/Switch5-v1")                    # the same for streams
    check_team("SME/Team4-v1")                        # the same for teams, through PettingZoo

A check raises `ConformanceError` with the expected and the actual value. The checks play whole
episodes with actions between optimal and random ones, so that some end early if D > 0.
"""

from sme_registry.testing.comparing import ConformanceError
from sme_registry.testing.single import (
    check_definition,
    check_determinism,
    check_env_spec,
    check_gymnasium,
    check_info,
    check_optimum,
    check_pickling,
    check_sme,
    check_vector,
)
from sme_registry.testing.stream import check_stream, check_stream_definition
from sme_registry.testing.team import (
    check_pettingzoo,
    check_team,
    check_team_definition,
    check_team_determinism,
    check_team_optimum,
    check_team_pickling,
    check_turns,
)

__all__ = [
    "ConformanceError",
    "check_definition",
    "check_determinism",
    "check_env_spec",
    "check_gymnasium",
    "check_info",
    "check_optimum",
    "check_pettingzoo",
    "check_pickling",
    "check_sme",
    "check_stream",
    "check_stream_definition",
    "check_team",
    "check_team_definition",
    "check_team_determinism",
    "check_team_optimum",
    "check_team_pickling",
    "check_turns",
    "check_vector",
]
