"""An index that answers over HTTP: the door, the queue behind it, and the replicas that compute.
Knows Ray, not the network.
"""
