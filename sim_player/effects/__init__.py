"""The effects of the simulator; `sim_player.effects.table` names them all."""
