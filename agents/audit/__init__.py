"""Audit of a privacy claim: two adjacent worlds, an adversary, and a statistical test.

A release model of one's own is audited as any other, where it adds its noise by a
`dptse_env.release.noise.Noise`:

    config = make_config("dptse_env:dptse/ShortHighway-v0", {"privacy": {"preset": MyRelease}})
    record = RecordLibrary().get(config.corridor, 0)
    print(audit_environment(config, record, trials=5000).verdict)
    print(audit_one_run(config, record).verdict)
"""
