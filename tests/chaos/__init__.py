"""The fault campaign: processes killed and files damaged on purpose."""
