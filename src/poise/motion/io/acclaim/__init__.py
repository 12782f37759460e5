"""Acclaim (CMU): AMC motion with the ASF skeleton that it needs."""
