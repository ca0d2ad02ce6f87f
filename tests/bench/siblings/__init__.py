"""Is an aircraft verified sooner with what its siblings have learnt, and is one that differs from them found?"""
