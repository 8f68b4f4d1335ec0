"""A photo matched with the map's pixels: where its middle lies, within metres.

In: a photo, a window of the map with known ground, and what is known of the camera. Out: a
`Refinement`: position, heading, footprint, inliers, an ellipse. Begin with `refine.py`.
`map_windows.py` gets windows around candidates, `local_features.py` finds and matches points,
`ground_fit.py` fits the homography and judges whether a camera makes it, `gate.py` judges
whether that holds, `photo_pose.py` what a photo's tags say of its camera, `map_features.py` finds
places by the features of the whole map (FAISS), which `kept_features.py` keeps in a file. OpenCV
does the features and the robust estimate.
"""
