"""A feature table of crops of real overhead images by a trained network, for `index.py --table`.

Crops of any place, size and turn of each image, resized to the network's pixels; crops of one image
lie near each other as views of one place do. Queries are crops of their own. The table is what
`embed_gallery` writes, in float16.
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
from pipeline.features.table import Floats, PartFooter, PartRows, write_part
from pipeline.images.decode import decode
from pipeline.index.recall import RECALL_QUERIES

BATCH = 512
SMALLEST = 0.35  # side of a crop as a share of the image's
METRES_PER_PIXEL = 0.3
METRES_PER_DEGREE = 111_195


def crops(
    images_N: list[Tensor], order: np.ndarray, size: int, rng: np.random.Generator
) -> Iterator[tuple[Tensor, np.ndarray]]:
    """Batches (B, 3, size, size) of bytes, and of each crop its image and the middle (x, y) in
    pixels, (B, 3).
    """
    for first in range(0, len(order), BATCH):
        batch, said = [], []
        for number in order[first : first + BATCH].tolist():
            image_3HW = images_N[number]
            side = int(min(image_3HW.shape[1:]) * rng.uniform(SMALLEST, 1))
            y, x = (int(rng.integers(0, extent - side + 1)) for extent in image_3HW.shape[1:])
            turned = image_3HW[None, :, y : y + side, x : x + side].rot90(
                int(rng.integers(4)), (2, 3)
            )
            crop = turned.contiguous(
                memory_format=torch.channels_last
            )  # bytes of this layout are resized five times as fast
            batch.append(F.interpolate(crop, (size, size), mode="bilinear", antialias=True))
            said.append((number, x + side / 2, y + side / 2))
        yield torch.cat(batch).contiguous(memory_format=torch.channels_last), np.array(said)


def write_split(
    arguments: argparse.Namespace,
    images_N: list[Tensor],
    names: list[str],
    split: str,
    view: str,
    rows: int,
    seed: int,
) -> None:
    """Embed `rows` crops and write the parts of one split."""
    checkpoint = loads(Path(arguments.checkpoint).read_bytes(), arguments.checkpoint)
    encoder = build_encoder(checkpoint)
    rng = np.random.default_rng(seed)
    order = rng.permutation(np.arange(rows) % len(images_N))
    made, begin = crops(images_N, order, checkpoint.network.image_size, rng), time.perf_counter()
    waiting: list[tuple[Floats, np.ndarray]] = []
    written = 0
    for images_B3HW, said_B3 in made:
        waiting.append((embed(encoder, images_B3HW, mirror=False).numpy(), said_B3))
        held = sum(len(said) for _, said in waiting)
        if held >= PART_ROWS or written + held == rows:
            vectors, said = (np.concatenate([pair[i] for pair in waiting]) for i in (0, 1))
            number, count = written // PART_ROWS, len(said)
            degrees = said[:, 1:] * METRES_PER_PIXEL / METRES_PER_DEGREE
            part = PartRows(
                keys=[f"{split}-{view}-{written + i:09d}" for i in range(count)],
                locations=[names[int(n)] for n in said[:, 0]],
                views=[view] * count,
                splits=[split] * count,
                lats=(said[:, 0] // 40 * 0.01 + degrees[:, 1]).tolist(),
                lons=(said[:, 0] % 40 * 0.01 + degrees[:, 0]).tolist(),
                embeddings_BD=vectors,
            )
            footer = PartFooter(
                fingerprint=arguments.checkpoint, shard_sha256=f"{seed}-{number}", rows=count
            )
            write_part(
                f"{arguments.out}/{split}-{view}-{number:06d}.parquet", part, footer, "float16"
            )
            written, waiting = written + count, []
            print(
                f"{split}: {written:,} of {rows:,}, {written / (time.perf_counter() - begin):.0f} crops/s",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--imagery", required=True, help="folder of overhead images")
    parser.add_argument("--checkpoint", required=True, help="a last.pt of jobs/train.py")
    parser.add_argument("--out", required=True, help="folder of the table")
    parser.add_argument("--rows", type=int, default=200_000)
    arguments = parser.parse_args()
    paths = sorted(Path(arguments.imagery).glob("*.jpg"))
    images_N = [torch.from_numpy(decode(path.read_bytes())).permute(2, 0, 1) for path in paths]
    names = [path.stem for path in paths]
    write_split(arguments, images_N, names, "query", "drone", RECALL_QUERIES, seed=1)
    write_split(arguments, images_N, names, "gallery", "satellite", arguments.rows, seed=0)


if __name__ == "__main__":
    main()
