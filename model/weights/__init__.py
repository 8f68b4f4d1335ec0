"""Public weights -> our networks.

In: a `.pth` or `.safetensors` file from elsewhere. Out: tensors by name, and modules that hold
them. `torch_files.py` reads files of torch.save without running their code, `unwrap.py` finds the
state dict in a checkpoint and takes prefixes off its names, `load.py` is the one loader: it finds
the backbone of a state dict and loads it by a table of foreign names (each backbone has its own),
`lpn.py` has the table of LPN's three_view_net. Begin with `load.py`.
"""
