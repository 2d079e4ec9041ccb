// Encoder of animated GIFs, as pages of S4A load no package: 256 colours by median cut, then LZW.

const bin = (p, i) => ((p[i] >> 3) << 11) | ((p[i + 1] >> 2) << 5) | (p[i + 2] >> 3); // 5, 6 and 5 bits of a pixel
const binColour = (b) => [((b >> 11) * 255) / 31, (((b >> 5) & 63) * 255) / 63, ((b & 31) * 255) / 31];

// A palette of 256 colours for the pixels of sample frames, and a function bin -> index of the nearest colour.
function paletteOf(frames) {
  const count = new Uint32Array(65536), nearest = new Int16Array(65536).fill(-1);
  for (const p of frames) for (let i = 0; i < p.length; i += 4) count[bin(p, i)]++;
  const boxOfBins = (bins) => {
    const side = [0, 1, 2].map((c) => {
      const values = bins.map((b) => binColour(b)[c]);
      return values.reduce((a, v) => Math.max(a, v), 0) - values.reduce((a, v) => Math.min(a, v), 255);
    });
    const weight = bins.reduce((sum, b) => sum + count[b], 0), longest = Math.max(...side);
    return { bins, weight, along: side.indexOf(longest), score: Math.sqrt(weight) * longest }; // large uniform areas need few colours
  };
  const boxes = [boxOfBins([...count.keys()].filter((b) => count[b]))];
  while (boxes.length < 256) {
    const box = boxes.reduce((a, b) => (b.score > a.score ? b : a));
    if (!box.score) break; // fewer colours than that
    box.bins.sort((a, b) => binColour(a)[box.along] - binColour(b)[box.along]);
    let at = 0, sum = 0;
    while (at < box.bins.length - 1 && (!at || sum < box.weight / 2)) sum += count[box.bins[at++]];
    boxes.splice(boxes.indexOf(box), 1, boxOfBins(box.bins.slice(0, at)), boxOfBins(box.bins.slice(at)));
  }
  const colours = boxes.map(({ bins, weight }, index) => {
    bins.forEach((b) => (nearest[b] = index));
    return [0, 1, 2].map((c) => Math.round(bins.reduce((sum, b) => sum + count[b] * binColour(b)[c], 0) / weight));
  });
  const colourOf = (b) => {
    if (nearest[b] >= 0) return nearest[b];
    const distances = colours.map((colour) => binColour(b).reduce((sum, v, c) => sum + (v - colour[c]) ** 2, 0));
    return (nearest[b] = distances.indexOf(Math.min(...distances)));
  };
  return { colours, colourOf };
}

// The codes of GIF's LZW: of 9 to 12 bits, the lowest bit first; 256 clears the table and 257 ends.
function lzw(pixels) {
  const bytes = [], table = new Uint16Array(4096 << 8); // code of a sequence by the code before and the next pixel, 0 for none
  let size = 9, free = 258, buffer = 0, bits = 0, code = pixels[0];
  const put = (value) => {
    buffer |= value << bits;
    for (bits += size; bits >= 8; bits -= 8, buffer >>>= 8) bytes.push(buffer & 255);
  };
  put(256);
  for (let i = 1; i < pixels.length; i++) {
    const pair = (code << 8) | pixels[i];
    if (table[pair]) {
      code = table[pair];
      continue;
    }
    put(code);
    code = pixels[i];
    if (free < 4096) {
      if (free === 1 << size) size++;
      table[pair] = free++;
      continue;
    }
    put(256);
    table.fill(0);
    [size, free] = [9, 258];
  }
  put(code);
  if (free === 1 << size && size < 12) size++; // the decoder has one more code
  put(257);
  if (bits) bytes.push(buffer & 255);
  return bytes;
}

// Encode `n` frames; `frame(i)` returns RGBA, and is called twice for the frames that determine the palette.
async function gif({ width, height, n, hundredths, frame }) {
  const word = (x) => [x & 255, x >> 8], text = (s) => [...s].map((letter) => letter.charCodeAt(0));
  const sample = [];
  for (let i = 0; i < n; i += Math.ceil(n / 6)) sample.push((await frame(i)).slice());
  const { colours, colourOf } = paletteOf(sample), table = new Uint8Array(768);
  colours.forEach((colour, i) => table.set(colour, 3 * i));
  const head = [...text("GIF89a"), ...word(width), ...word(height), 0xf7, 0, 0], forever = [0x21, 0xff, 11, ...text("NETSCAPE2.0"), 3, 1, 0, 0, 0];
  const parts = [new Uint8Array(head), table, new Uint8Array(forever)], pixels = new Uint8Array(width * height);
  for (let i = 0; i < n; i++) {
    const p = await frame(i);
    for (let j = 0; j < pixels.length; j++) pixels[j] = colourOf(bin(p, 4 * j));
    const bytes = lzw(pixels), blocks = [];
    for (let j = 0; j < bytes.length; j += 255) blocks.push(Math.min(255, bytes.length - j), ...bytes.slice(j, j + 255));
    parts.push(new Uint8Array([0x21, 0xf9, 4, 0, ...word(hundredths), 0, 0, 0x2c, 0, 0, 0, 0, ...word(width), ...word(height), 0, 8]), new Uint8Array(blocks), new Uint8Array([0]));
  }
  return new Blob([...parts, new Uint8Array([0x3b])], { type: "image/gif" });
}
