"""A feature table of crops of real overhead images by a trained network, for `index.py --table`.

Crops have any position, size and quarter turn of each image and are resized to the network's
pixels; crops of one image are near each other as views of one place are. Queries are separate
crops. The table is what `embed_gallery` writes, in float16. A killed run resumes with the parts
that are missing. Prints the crops per second of writing as a ratio to those of the encoder alone,
in the same run.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from jobs.encoding.encoder import read_checkpoint_bytes
from model.checkpoint import build_encoder, loads
from model.inference.embed import FastEncoder
from model.inference.optimise import optimise_encoder
from model.weights.builtin import BUILTIN
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.images.decode import decode
from pipeline.index.tuning.ground_truth import RECALL_QUERIES

PART_ROWS = 16_384
MIN_SIDE = 0.35
"Smallest side of a crop, as a fraction of its image's."
METRES_PER_PIXEL = 0.3
METRES_PER_DEGREE = 111_195


def crops(
    images_N: list[Tensor], order: np.ndarray, size: int, batch: int, rng: np.random.Generator
) -> Iterator[tuple[Tensor, np.ndarray]]:
    """Batches (B, 3, size, size) of bytes, and (B, 3): image number, centre x and y in pixels."""
    for first in range(0, len(order), batch):
        crops_, centres = [], []
        for number in order[first : first + batch].tolist():
            image_3HW = images_N[number]
            side = int(min(image_3HW.shape[1:]) * rng.uniform(MIN_SIDE, 1))
            y, x = (int(rng.integers(0, extent - side + 1)) for extent in image_3HW.shape[1:])
            crop_13HW = image_3HW[None, :, y : y + side, x : x + side]
            turned_13HW = crop_13HW.rot90(int(rng.integers(4)), (2, 3))
            # Bytes of this layout are resized five times as fast.
            turned_13HW = turned_13HW.contiguous(memory_format=torch.channels_last)
            crops_.append(F.interpolate(turned_13HW, (size, size), mode="bilinear", antialias=True))
            centres.append((number, x + side / 2, y + side / 2))
        yield torch.cat(crops_).contiguous(memory_format=torch.channels_last), np.array(centres)


def write_split(
    args: argparse.Namespace,
    encoder: FastEncoder,
    size: int,
    images_N: list[Tensor],
    names: list[str],
    split: str,
    view: str,
    rows: int,
    seed: int,
) -> None:
    """Embed `rows` crops of `size` px and write the parts of one split that are not there yet."""
    order = np.random.default_rng(seed).permutation(np.arange(rows) % len(images_N))
    done, encoding, begin = 0, 0.0, time.perf_counter()
    for number, first in enumerate(range(0, rows, PART_ROWS)):
        path = f"{args.out}/{split}-{view}-{number:06d}.parquet"
        if Path(path).exists():
            continue
        part_order = order[first : first + PART_ROWS]
        rng = np.random.default_rng([seed, number])
        blocks, found = [], []
        for images_B3HW, centres_B3 in crops(images_N, part_order, size, args.batch_size, rng):
            started = time.perf_counter()
            blocks.append(encoder(images_B3HW).numpy())
            encoding += time.perf_counter() - started
            found.append(centres_B3)
        centres, count = np.concatenate(found), len(part_order)
        degrees = centres[:, 1:] * METRES_PER_PIXEL / METRES_PER_DEGREE
        part = PartRows(
            keys=[f"{split}-{view}-{first + i:09d}" for i in range(count)],
            locations=[names[int(n)] for n in centres[:, 0]],
            views=[view] * count,
            splits=[split] * count,
            lats=(centres[:, 0] // 40 * 0.01 + degrees[:, 1]).tolist(),
            lons=(centres[:, 0] % 40 * 0.01 + degrees[:, 0]).tolist(),
            embeddings_BD=np.concatenate(blocks),
        )
        shard = f"{seed}-{number}"
        footer = PartFooter(fingerprint=args.checkpoint, shard_sha256=shard, rows=count)
        write_part(path, part, footer, "float16")
        done += count
        seconds = time.perf_counter() - begin
        print(
            f"{split}: {first + count:,} of {rows:,}, {done / seconds:.0f} crops/s, "
            f"{encoding / seconds:.2f} x the encoder alone",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--imagery", required=True, help="folder of overhead images, JPEG")
    add("--checkpoint", default=BUILTIN, help="builtin, or a last.pt of jobs/train.py")
    add("--out", required=True, help="folder of the table")
    add("--rows", type=int, default=200_000, help="rows of the gallery")
    add("--queries", type=int, default=RECALL_QUERIES, help="rows of the queries")
    add("--batch-size", type=int, default=512, help="crops of a batch")
    args = parser.parse_args()
    paths = sorted(Path(args.imagery).rglob("*.jpg"))
    if not paths:
        raise SystemExit(f"no *.jpg below {args.imagery}")
    images_N = [torch.from_numpy(decode(path.read_bytes())).permute(2, 0, 1) for path in paths]
    names = [path.stem for path in paths]
    checkpoint = loads(read_checkpoint_bytes(args.checkpoint), args.checkpoint)
    size = checkpoint.network.image_size
    probe_order = np.arange(4) % len(images_N)
    probe_B3HW, _ = next(crops(images_N, probe_order, size, 4, np.random.default_rng(2)))
    encoder = optimise_encoder(
        build_encoder(checkpoint),
        probe_B3HW=probe_B3HW,
        batch_size=args.batch_size,
        precision="float32",
        mirror=False,
        images=args.rows,
    )
    write_split(args, encoder, size, images_N, names, "query", "drone", args.queries, seed=1)
    write_split(args, encoder, size, images_N, names, "gallery", "satellite", args.rows, seed=0)


if __name__ == "__main__":
    main()
