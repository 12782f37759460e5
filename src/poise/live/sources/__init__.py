"""Where motion comes from: a file, VMC, JSON. Each puts packets into an `Inbox`; none knows physics."""
