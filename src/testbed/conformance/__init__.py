"""The conformance kit: what an estimator must keep to be one of the testbed's, checked on anybody's.

A check is named in ``kit.CHECKS``. An estimator that by its definition cannot pass one of ``kit.CLAIMS`` says so in a
class attribute, ``not_claimed = {"NAME": "reason"}``.
"""
