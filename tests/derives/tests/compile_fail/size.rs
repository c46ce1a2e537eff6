use blastema::Event;

#[derive(Clone, Event)]
#[contract(max_size = 32 * 1024 * 1024)]
struct Huge(Vec<u8>);

fn main() {
    let _ = <Huge as blastema::core::Contract>::MAX_SIZE;
}
