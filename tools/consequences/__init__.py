"""What a client, or its operator, suffers from each wrong hand: ``make consequences``.

Models of the genuine clients drive a wrong hand and the reference on the virtual clock, in the same
sessions (:mod:`tools.consequences.sessions`). What differs for the client is measured in a few
kinds, each with one limit (:mod:`tools.consequences.kinds`). The table says of each wrong hand what
its consequences are, and of each requirement the worst consequence of the hands that fail it: from
that follow the levels.
"""
