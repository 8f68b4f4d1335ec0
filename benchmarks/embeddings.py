"""A feature table of crops of real overhead images by a trained network, for `index.py --table`.

Crops have any position, size and quarter turn of each image and are resized to the network's
pixels; crops of one image are near each other as views of one place are. Queries are separate
crops. The table is what `embed_gallery` writes, in float16. Prints the crops per second of writing
as a ratio to those of the encoder alone, in the same run.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from index import PART_ROWS
from torch import Tensor

from model.checkpoint import build_encoder, loads
from model.inference.embed import embed
from pipeline.core.arrays import Floats
from pipeline.features.part import PartFooter, PartRows, write_part
from pipeline.images.decode import decode
from pipeline.index.recall import RECALL_QUERIES

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
    images_N: list[Tensor],
    names: list[str],
    split: str,
    view: str,
    rows: int,
    seed: int,
) -> None:
    """Embed `rows` crops and write the parts of one split."""
    checkpoint = loads(Path(args.checkpoint).read_bytes(), args.checkpoint)
    encoder = build_encoder(checkpoint)
    rng = np.random.default_rng(seed)
    order = rng.permutation(np.arange(rows) % len(images_N))
    buffered: list[tuple[Floats, np.ndarray]] = []
    written, encoding, begin = 0, 0.0, time.perf_counter()
    for images_B3HW, centres_B3 in crops(
        images_N, order, checkpoint.network.image_size, args.batch_size, rng
    ):
        started = time.perf_counter()
        vectors_BE = embed(encoder, images_B3HW, mirror=False).numpy()
        encoding += time.perf_counter() - started
        buffered.append((vectors_BE, centres_B3))
        count = sum(len(centres) for _, centres in buffered)
        if count >= PART_ROWS or written + count == rows:
            vectors, centres = (np.concatenate([pair[i] for pair in buffered]) for i in (0, 1))
            number = written // PART_ROWS
            degrees = centres[:, 1:] * METRES_PER_PIXEL / METRES_PER_DEGREE
            part = PartRows(
                keys=[f"{split}-{view}-{written + i:09d}" for i in range(count)],
                locations=[names[int(n)] for n in centres[:, 0]],
                views=[view] * count,
                splits=[split] * count,
                lats=(centres[:, 0] // 40 * 0.01 + degrees[:, 1]).tolist(),
                lons=(centres[:, 0] % 40 * 0.01 + degrees[:, 0]).tolist(),
                embeddings_BD=vectors,
            )
            footer = PartFooter(
                fingerprint=args.checkpoint, shard_sha256=f"{seed}-{number}", rows=count
            )
            path = f"{args.out}/{split}-{view}-{number:06d}.parquet"
            write_part(path, part, footer, "float16")
            written, buffered = written + count, []
            seconds = time.perf_counter() - begin
            print(
                f"{split}: {written:,} of {rows:,}, {written / seconds:.0f} crops/s, "
                f"{encoding / seconds:.2f} x the encoder alone",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--imagery", required=True, help="folder of overhead images, JPEG")
    add("--checkpoint", required=True, help="a last.pt of jobs/train.py")
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
    write_split(args, images_N, names, "query", "drone", args.queries, seed=1)
    write_split(args, images_N, names, "gallery", "satellite", args.rows, seed=0)


if __name__ == "__main__":
    main()
