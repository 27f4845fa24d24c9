"""A robustness campaign: fuzzers, unplugs, kills and a soak.

``python -m tools.campaign --minutes 30``; docs/campaign.md describes what it does and how a finding
is repeated.
"""
