// Kernels that NVRTC compiles when they are first used, without any header: bf16 is handled by its bits. Loaded and launched by
// `compiled.rs` and `launches.rs` beside this file, checked against the composed forms in `../fused.rs`.
//
// Rows of attention are in the order [key head, item, head of the group, row of the item]; a row's number is `row` below.

typedef unsigned short bf16;

static __device__ __forceinline__ float wide(bf16 bits) {
    return __uint_as_float((unsigned int)bits << 16);
}

// To the nearest, ties to even. NaN stays NaN.
static __device__ __forceinline__ bf16 rounded(float value) {
    unsigned int bits = __float_as_uint(value);
    if ((bits & 0x7fffffffu) > 0x7f800000u) return (bf16)((bits >> 16) | 0x40u);
    return (bf16)((bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16);
}

// Of all lanes, in all lanes.
static __device__ __forceinline__ float warp_sum(float value) {
    for (int lanes = 16; lanes > 0; lanes /= 2) value += __shfl_xor_sync(0xffffffffu, value, lanes);
    return value;
}

static __device__ __forceinline__ float warp_max(float value) {
    for (int lanes = 16; lanes > 0; lanes /= 2) value = fmaxf(value, __shfl_xor_sync(0xffffffffu, value, lanes));
    return value;
}

// out = residual + (y + bias); `bias` and `residual` may be null. A block is a row; those of `y` are `stride` apart.
extern "C" __global__ void widen(float *out, const bf16 *y, unsigned int stride, const float *bias, const float *residual,
                                 unsigned int width) {
    size_t to = (size_t)blockIdx.x * width, from = (size_t)blockIdx.x * stride;
    for (unsigned int i = threadIdx.x; i < width; i += blockDim.x) {
        float value = wide(y[from + i]);
        if (bias) value += bias[i];
        if (residual) value = residual[to + i] + value;
        out[to + i] = value;
    }
}

// out = x / sqrt(mean(x^2) + eps) * weight. A block of whole warps is a row.
extern "C" __global__ void rms_norm(bf16 *out, const float *x, const float *weight, unsigned int width, float eps) {
    __shared__ float parts[32];
    size_t row = (size_t)blockIdx.x * width;
    float sum = 0.0f;
    for (unsigned int i = threadIdx.x; i < width; i += blockDim.x) sum += x[row + i] * x[row + i];
    sum = warp_sum(sum);
    if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = sum;
    __syncthreads();
    sum = 0.0f;
    for (unsigned int i = 0; i < blockDim.x / 32; i++) sum += parts[i];
    float scale = 1.0f / sqrtf(sum / (float)width + eps);
    for (unsigned int i = threadIdx.x; i < width; i += blockDim.x) out[row + i] = rounded(x[row + i] * scale * weight[i]);
}

// out = silu(gate + gate_bias) * (up + up_bias); the biases may be null. A block is a row.
extern "C" __global__ void swiglu(bf16 *out, const bf16 *gate, const bf16 *up, const float *gate_bias, const float *up_bias,
                                  unsigned int width) {
    size_t row = (size_t)blockIdx.x * width;
    for (unsigned int i = threadIdx.x; i < width; i += blockDim.x) {
        float g = wide(gate[row + i]), u = wide(up[row + i]);
        if (gate_bias) g += gate_bias[i];
        if (up_bias) u += up_bias[i];
        out[row + i] = rounded(g / (1.0f + expf(-g)) * u);
    }
}

// Rows [item, row of the item] of all heads to rows of attention, multiplied by `scale`; an item's `period` rows become `padded`, the
// further ones zeros. A block is a row of the result.
extern "C" __global__ void heads_first(bf16 *out, const float *x, float scale, unsigned int items, unsigned int key_heads,
                                       unsigned int group, unsigned int period, unsigned int padded, unsigned int head_dim) {
    unsigned int i = blockIdx.x % padded, rest = blockIdx.x / padded;
    unsigned int g = rest % group, item = rest / group % items, head = rest / group / items;
    size_t to = (size_t)blockIdx.x * head_dim;
    size_t from = (((size_t)item * period + i) * key_heads * group + head * group + g) * head_dim;
    for (unsigned int d = threadIdx.x; d < head_dim; d += blockDim.x)
        out[to + d] = i < period ? rounded(x[from + d] * scale) : (bf16)0;
}

// Softmax of each row's first `columns` scores; where `causal`, row i of `period` sees `period - 1 - i` fewer. The result is 0 in the other
// columns of `stride`. A warp is a row.
extern "C" __global__ void probabilities(bf16 *out, const float *scores, unsigned int rows, unsigned int stride, unsigned int columns,
                                         unsigned int period, unsigned int causal) {
    unsigned int row = blockIdx.x * (blockDim.x / 32) + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (row >= rows) return;
    unsigned int seen = causal ? columns - (period - 1 - row % period) : columns;
    const float *score = scores + (size_t)row * stride;
    bf16 *p = out + (size_t)row * stride;
    float max = -__uint_as_float(0x7f800000u), sum = 0.0f;
    for (unsigned int c = lane; c < seen; c += 32) max = fmaxf(max, score[c]);
    max = warp_max(max);
    for (unsigned int c = lane; c < seen; c += 32) sum += expf(score[c] - max);
    sum = warp_sum(sum);
    for (unsigned int c = lane; c < stride; c += 32) p[c] = c < seen ? rounded(expf(score[c] - max) / sum) : (bf16)0;
}

// The same where each row sees `shared` keys, whose scores are given, and beside them `own` keys of its item, at most 32, whose scores
// are made here from queries `q` and keys `k`, `[items * own, key_heads * head_dim]`. Their probabilities follow those of the shared keys.
extern "C" __global__ void shared_probabilities(bf16 *out, const float *scores, const bf16 *q, const float *k, unsigned int rows,
                                                unsigned int stride, unsigned int shared, unsigned int own, unsigned int period,
                                                unsigned int causal, unsigned int items, unsigned int key_heads,
                                                unsigned int group, unsigned int head_dim) {
    unsigned int row = blockIdx.x * (blockDim.x / 32) + threadIdx.x / 32, lane = threadIdx.x % 32;
    if (row >= rows) return;
    unsigned int item = row / (period * group) % items, head = row / (period * group) / items;
    unsigned int seen = causal ? own - (period - 1 - row % period) : own;
    const float *score = scores + (size_t)row * stride;
    const bf16 *query = q + (size_t)row * head_dim;
    float mine = -__uint_as_float(0x7f800000u);
    for (unsigned int c = 0; c < seen; c++) {
        const float *key = k + (((size_t)item * own + c) * key_heads + head) * head_dim;
        float dot = 0.0f;
        for (unsigned int d = lane; d < head_dim; d += 32) dot += wide(query[d]) * key[d];
        dot = warp_sum(dot);
        if (lane == c) mine = dot;
    }
    bf16 *p = out + (size_t)row * stride;
    float max = mine, sum = 0.0f;
    for (unsigned int c = lane; c < shared; c += 32) max = fmaxf(max, score[c]);
    max = warp_max(max);
    for (unsigned int c = lane; c < shared; c += 32) sum += expf(score[c] - max);
    mine = lane < seen ? expf(mine - max) : 0.0f;
    sum = warp_sum(sum + mine);
    for (unsigned int c = lane; c < shared; c += 32) p[c] = rounded(expf(score[c] - max) / sum);
    for (unsigned int c = lane; shared + c < stride; c += 32) p[shared + c] = c < seen ? rounded(mine / sum) : (bf16)0;
}

// Rows of attention to rows [item, row of the item] of all heads. Where there are `own` keys, their values `v`, shaped as `k` above, are
// added, by the probabilities `p` that follow those of `shared` keys. A block is a row of attention.
extern "C" __global__ void heads_last(float *out, const float *x, const bf16 *p, const float *v, unsigned int stride,
                                      unsigned int shared, unsigned int own, unsigned int items, unsigned int key_heads,
                                      unsigned int group, unsigned int period, unsigned int head_dim) {
    unsigned int i = blockIdx.x % period, rest = blockIdx.x / period;
    unsigned int g = rest % group, item = rest / group % items, head = rest / group / items;
    size_t from = (size_t)blockIdx.x * head_dim;
    size_t to = (((size_t)item * period + i) * key_heads * group + head * group + g) * head_dim;
    for (unsigned int d = threadIdx.x; d < head_dim; d += blockDim.x) {
        float value = x[from + d];
        for (unsigned int c = 0; c < own; c++) {
            float weight = wide(p[(size_t)blockIdx.x * stride + shared + c]);
            value += weight * v[(((size_t)item * own + c) * key_heads + head) * head_dim + d];
        }
        out[to + d] = value;
    }
}
