"""From sections of a configuration to objects, hands and motions."""
